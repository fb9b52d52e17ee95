//! Streams of a node as streams of tasks.

use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Wake, Waker};
use std::time::Duration;

use cara_std::{CommunicationSystem, Definition, Error, Peer, Sample, SampleStream, Stream, Unit};

use super::runtime;
use super::starving::beside;
use crate::support::{counter, meet, number, pair, until};

/// A vehicle with the stream `counts`, and the manager's view of it.
fn vehicle() -> (CommunicationSystem, Unit, Stream, Peer) {
    let (manager, agv) = pair();
    let definition = Definition::stream("counts(number: int)").unwrap();
    let counts = agv.my_function_list().add_stream(&definition, Duration::ZERO).unwrap();
    let (peer, _) = meet(&manager, &agv);
    (manager, agv, counts, peer)
}

fn subscribe(peer: &Peer, interval: Duration) -> SampleStream {
    peer.stream("counts").unwrap().subscribe_async(interval)
}

fn counted(sample: Option<Result<Sample, Error>>) -> i64 {
    sample.unwrap().unwrap().value("number").unwrap()
}

#[test]
fn values_are_a_stream_whose_newest_wins() {
    let (_manager, _agv, counts, peer) = vehicle();
    let mut stream = subscribe(&peer, Duration::ZERO);
    counts.publish(&number(1)).unwrap();
    runtime().block_on(async { assert_eq!(counted(stream.next().await), 1) });
    for value in 2..=9 {
        counts.publish(&number(value)).unwrap();
    }
    until("the last one has come", || stream.latest().is_some_and(|sample| sample.value("number") == Ok(9_i64)));
    runtime().block_on(async {
        assert_eq!(counted(stream.next().await), 9, "those between are passed over");
        assert_eq!(super::once(&mut pin!(stream.next())).await.map(counted), None, "none is returned twice");
    });
}

/// Runs `waits` in a task of its own, which is polled only when it has been woken.
fn woken<R: Send + 'static>(
    waits: impl Future<Output = R> + Send + 'static,
    brings_about: impl FnOnce() + Send + 'static,
) -> R {
    beside(async { tokio::spawn(waits).await.unwrap() }, brings_about)
}

#[test]
fn a_stream_wakes_its_task_and_holds_no_thread() {
    let (_manager, _agv, counts, peer) = vehicle();
    let [mut quick, mut slow] = [0, 100].map(|millis| subscribe(&peer, Duration::from_millis(millis)));
    let later = counts.clone();
    let one = async move { counted(quick.next().await) };
    assert_eq!(woken(one, move || later.publish(&number(1)).unwrap()), 1);
    // The second value is there, and waits for the pace.
    let two = async move { [counted(slow.next().await), counted(slow.next().await)] };
    assert_eq!(woken(two, move || counts.publish(&number(2)).unwrap()), [1, 2]);
}

#[test]
fn a_stream_ends_with_its_unit_and_with_an_error_that_is_its_last_item() {
    let (manager, agv, counts, peer) = vehicle();
    let [mut stopped, mut removed] = [(); 2].map(|()| subscribe(&peer, Duration::ZERO));
    let gone = agv.clone();
    let removes = move || gone.my_function_list().remove("counts").unwrap();
    let refused = woken(async move { [removed.next().await, removed.next().await] }, removes);
    assert!(matches!(refused, [Some(Err(Error::StaleFunction | Error::UnknownFunction)), None]), "{refused:?}");
    let again = agv.my_function_list().add_stream(counts.definition(), Duration::ZERO).unwrap();
    again.publish(&number(3)).unwrap();
    agv.publish_my_function_list().unwrap();
    until("the stream is there again", || stopped.latest().is_some());
    assert_eq!(counted(runtime().block_on(stopped.next())), 3, "the other handle had not looked at the refusal");
    let end = woken(async move { [stopped.next().await, stopped.next().await] }, move || manager.stop());
    assert!(matches!(end, [Some(Err(Error::NotRunning)), None]), "{end:?}");
}

/// A waker that is left behind would keep the task, and what it holds.
#[test]
fn a_stream_that_is_dropped_ends_its_subscription_and_leaves_no_waker() {
    struct Task;
    impl Wake for Task {
        fn wake(self: Arc<Self>) {}
    }
    let (_manager, agv, counts, peer) = vehicle();
    let other = subscribe(&peer, Duration::ZERO);
    let mut stream = subscribe(&peer, Duration::from_secs(60));
    counts.publish(&number(1)).unwrap();
    assert_eq!(counted(runtime().block_on(stream.next())), 1);
    let task = Arc::new(Task);
    let waker = Waker::from(task.clone());
    // It waits for a value and for the pace.
    assert!(pin!(stream.next()).poll(&mut Context::from_waker(&waker)).is_pending());
    drop(waker);
    assert!(Arc::strong_count(&task) > 1);
    drop(stream);
    assert_eq!(Arc::strong_count(&task), 1);
    drop(other);
    let sent = || counter(&agv.manager().unwrap().counters(), "SamplesSent");
    until("nothing is sent any more", || {
        let before = sent();
        counts.publish(&number(2)).unwrap();
        std::thread::sleep(Duration::from_millis(20));
        sent() == before
    });
}
