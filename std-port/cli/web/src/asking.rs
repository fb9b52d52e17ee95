//! What pages ask for: functions, calls, holds, stops, resets, surveys. Answers go to the page as they come, a line of JSON
//! each, of which the last one is `done` or `failed`.

use std::collections::HashMap;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes, to_bytes};
use axum::extract::{Extension, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use cara_std::control::protocol::{Answer, CallQuestion, Failure, Question};
use cara_tools::exit::Ended;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio::task::spawn_blocking;
use tokio::time::sleep;

use crate::limits::{BODY, CALLS, Place, RESETS};
use crate::picture::Section;
use crate::push::piecewise;
use crate::server::Shared;
use crate::users::User;
use crate::{Beat, Connection, Unit, form, guard};

/// A hold ends when its page has not said for so long that it is there.
pub(crate) const ATTENDED: Duration = Duration::from_millis(1500);
/// How often is looked whether it has.
const LOOK: Duration = Duration::from_millis(100);
/// Answers that wait for a page that reads slowly; then the manager waits.
const ANSWERS: usize = 64;
/// Likewise of a stop, which waits for no page: all nodes that a unit may have, and the end.
const STOP_ANSWERS: usize = 2048;
/// A line that says nothing, so often: a proxy takes a long silence for the end of an answer.
const SIGN_OF_LIFE: Duration = Duration::from_secs(5);
/// How long the doctor listens.
const LISTEN: Duration = Duration::from_secs(6);
/// How long managers are listened for, as by `cara scan`.
const LISTEN_TO_MANAGERS: Duration = Duration::from_secs(2);

type Asked = State<Arc<Shared>>;
/// Whose token the request has.
type Of = Extension<Arc<User>>;

/// A hold of a page.
pub(crate) struct Hold {
    /// Whose it is: nobody else's page keeps it.
    user: Arc<User>,
    /// When the page last said that it is there.
    last: Instant,
    /// Passes that on to the manager, once it is asked.
    beat: Option<Beat>,
}

/// The functions of a node: `{"node": …}`.
pub(crate) async fn functions(State(shared): Asked, Extension(user): Of, body: Body) -> Response {
    let node = match read(body).await {
        Ok(asked) => asked["node"].as_str().unwrap_or_default().to_owned(),
        Err(refusal) => return refusal,
    };
    // The semaphore is never closed. Pages wait for each other.
    let _turn = shared.functions.acquire().await;
    let own = shared.clone();
    let asked = spawn_blocking(move || {
        let mut lines = Vec::new();
        ask(&own, &user, false, &Question::Functions { node }, |line| {
            lines.push(line);
            true
        });
        lines
    });
    lines(&asked.await.unwrap_or_default())
}

/// A call, or with `"hold": true` one that is kept: until its end, or until the page is gone or says nothing more.
pub(crate) async fn call(State(shared): Asked, Extension(user): Of, body: Body) -> Response {
    let asked = match read(body).await {
        Ok(asked) => asked,
        Err(refusal) => return refusal,
    };
    let (question, is_held) = match form::call(asked) {
        Ok(call) => call,
        Err(text) => return lines(&[failed(&Failure::configuration("BadCall", text))]),
    };
    let Some(place) = Place::take(&shared.limits, |limits| &limits.calls) else { return busy("calls", CALLS) };
    let (to, answers) = mpsc::channel(ANSWERS);
    let hold = is_held.then(|| shared.begin_hold(user.clone()));
    spawn_blocking(move || {
        let _place = place;
        kept(&shared, &user, question, hold, &to);
        if let Some(hold) = hold {
            shared.holds().remove(&hold);
        }
    });
    streamed(answers)
}

/// Asks, and gives up when the page is gone.
fn kept(shared: &Arc<Shared>, user: &User, question: CallQuestion, hold: Option<u64>, to: &mpsc::Sender<Bytes>) {
    let reported = |line: &Value| to.blocking_send(piece(line)).is_ok();
    if !hold.is_none_or(|hold| reported(&json!({ "answer": "held", "hold": hold }))) {
        return;
    }
    let opened = shared.unit.connect(false).and_then(|mut way| {
        act_for(&mut *way, user)?;
        if let Some(hold) = hold {
            let beat = way.beats()?;
            shared.holds().entry(hold).and_modify(|hold| hold.beat = Some(beat));
        }
        Ok((way.cancel()?, way))
    });
    let (cancel, mut way) = match opened {
        Ok(opened) => opened,
        Err(error) => {
            reported(&failed(&failure(&error)));
            return;
        }
    };
    let unattended = Arc::new(AtomicBool::new(false));
    let watch =
        tokio::runtime::Handle::current().spawn(attend(shared.clone(), hold, to.clone(), cancel, unattended.clone()));
    let question = if hold.is_some() { Question::Hold(question) } else { Question::Call(question) };
    let mut has_ended = false;
    let outcome = way.ask(&question, &mut |answer| {
        has_ended |= matches!(answer, Answer::Done | Answer::Failed(_));
        if reported(&shown(&answer)) { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    });
    watch.abort();
    if unattended.load(Ordering::Acquire) {
        let text = "the page said nothing any more, as one that is hidden or asleep: what it held was released";
        reported(&failed(&Failure::configuration("Unattended", text)));
    } else if let Err(error) = outcome {
        reported(&failed(&failure(&error)));
    } else if !has_ended {
        reported(&json!({ "answer": "done" }));
    }
}

/// Ends what is asked when its page is gone, or does not attend what it holds.
async fn attend(
    shared: Arc<Shared>,
    hold: Option<u64>,
    to: mpsc::Sender<Bytes>,
    cancel: crate::Cancel,
    unattended: Arc<AtomicBool>,
) {
    let mut said = Instant::now();
    loop {
        let is_gone = tokio::select! {
            () = to.closed() => true,
            () = sleep(LOOK) => false,
        };
        if said.elapsed() >= SIGN_OF_LIFE {
            said = Instant::now();
            let _ = to.try_send(Bytes::from_static(b"\n"));
        }
        let last = hold.and_then(|hold| Some(shared.holds().get(&hold)?.last));
        let is_left = last.is_some_and(|last| last.elapsed() >= ATTENDED);
        if is_gone || is_left {
            unattended.store(is_left, Ordering::Release);
            return cancel();
        }
    }
}

/// `{"hold": …}`: its page is there. This alone renews what it holds.
pub(crate) async fn beat(State(shared): Asked, Extension(user): Of, body: Body) -> Response {
    let asked = match read(body).await {
        Ok(asked) => asked,
        Err(refusal) => return refusal,
    };
    let mut holds = shared.holds();
    match asked["hold"].as_u64().and_then(|hold| holds.get_mut(&hold)).filter(|hold| hold.user == user) {
        Some(hold) => {
            hold.last = Instant::now();
            hold.beat.iter().for_each(|beat| beat());
            StatusCode::NO_CONTENT.into_response()
        }
        None => StatusCode::GONE.into_response(),
    }
}

/// Does nothing: a page that comes to here could stop.
pub(crate) async fn ready(body: Body) -> Response {
    read(body).await.map_or_else(|refusal| refusal, |_| StatusCode::NO_CONTENT.into_response())
}

/// `{"node": …}`, or null for all. It is carried out to its end, also where the page is gone.
pub(crate) async fn stop(State(shared): Asked, Extension(user): Of, body: Body) -> Response {
    let node = match named(body).await {
        Ok(node) => node,
        Err(refusal) => return refusal,
    };
    let turns = if node.is_none() { shared.stops_of_all.clone() } else { shared.stops_of_one.clone() };
    let (to, answers) = mpsc::channel(STOP_ANSWERS);
    tokio::spawn(async move {
        let mut turn = turns.clone().try_acquire_owned().ok();
        if turn.is_none() {
            shared.limits.stops.refuse();
            // The semaphore is never closed.
            turn = turns.acquire_owned().await.ok();
        }
        spawn_blocking(move || {
            let _place = (turn, Place::take(&shared.limits, |limits| &limits.stops));
            carry_out(&shared, &user, &Question::Stop { node }, &to);
        });
    });
    streamed(answers)
}

/// Likewise, but for the turn.
pub(crate) async fn reset(State(shared): Asked, Extension(user): Of, body: Body) -> Response {
    let node = match named(body).await {
        Ok(node) => node,
        Err(refusal) => return refusal,
    };
    let Some(place) = Place::take(&shared.limits, |limits| &limits.resets) else { return busy("resets", RESETS) };
    let (to, answers) = mpsc::channel(STOP_ANSWERS);
    spawn_blocking(move || {
        let _place = place;
        carry_out(&shared, &user, &Question::Reset { node }, &to);
    });
    streamed(answers)
}

/// The page may be gone, or read nothing: what it asked for goes on.
fn carry_out(shared: &Shared, user: &User, question: &Question, to: &mpsc::Sender<Bytes>) {
    ask(shared, user, true, question, |line| {
        let _ = to.try_send(piece(&line));
        true
    });
}

/// The node that is stopped or reset, or `None` for all.
async fn named(body: Body) -> Result<Option<String>, Response> {
    match read(body).await? {
        Value::Object(asked) if asked.get("node").is_some_and(|node| node.is_null() || node.is_string()) => {
            Ok(asked["node"].as_str().map(str::to_owned))
        }
        _ => {
            let text = "that names no node, and null for all neither";
            Err(lines(&[failed(&Failure::configuration("BadQuestion", text))]))
        }
    }
}

/// Has the doctor look, and tells all pages what it found.
pub(crate) async fn doctor(State(shared): Asked, Extension(user): Of, body: Body) -> Response {
    survey(shared, &user, body, Section::Doctor, |unit| {
        let found = unit.findings(LISTEN)?;
        Ok(json!({ "findings": found["findings"], "listened_ms": found["listened_ms"] }))
    })
    .await
}

/// Has all managers asked that can be, and tells all pages which one has which vehicle.
pub(crate) async fn managers(State(shared): Asked, Extension(user): Of, body: Body) -> Response {
    survey(shared, &user, body, Section::Managers, |unit| {
        let found = unit.managers(LISTEN_TO_MANAGERS)?;
        Ok(json!({ "rows": found["rows"], "remarks": found["remarks"] }))
    })
    .await
}

/// One at a time. What was found is the row of the section, with the time.
async fn survey(
    shared: Arc<Shared>,
    user: &User,
    body: Body,
    section: Section,
    find: fn(&dyn Unit) -> anyhow::Result<Value>,
) -> Response {
    if let Some(refusal) = guard::unseen(user) {
        return refusal;
    }
    if let Err(refusal) = read(body).await {
        return refusal;
    }
    let Ok(_turn) = shared.surveys.try_acquire() else { return busy("surveys", 1) };
    let own = shared.clone();
    let found = spawn_blocking(move || find(&*own.unit)).await;
    let line = match found {
        Ok(Ok(mut found)) => {
            let mut picture = shared.picture();
            found["at"] = picture.now().into();
            picture.put(section, "", &found);
            json!({ "answer": "done" })
        }
        Ok(Err(error)) => failed(&failure(&error)),
        Err(_) => failed(&Failure::configuration("Failed", "the survey failed")),
    };
    lines(&[line])
}

/// Asks, and passes on each answer as a line until that says `false`. The last one is the end.
fn ask(shared: &Shared, user: &User, for_a_stop: bool, question: &Question, mut each: impl FnMut(Value) -> bool) {
    let outcome = shared.unit.connect(for_a_stop).and_then(|mut way| {
        let acts = act_for(&mut *way, user);
        // A stop is carried out also by a manager that knows of no users.
        if !matches!(question, Question::Stop { .. }) {
            acts?;
        }
        way.ask(question, &mut |answer| match each(shown(&answer)) {
            true => ControlFlow::Continue(()),
            false => ControlFlow::Break(()),
        })
    });
    if let Err(error) = outcome {
        each(failed(&failure(&error)));
    }
}

/// The manager decides what the user may do, and notes the name. It is not told of the only one, who may do everything.
fn act_for(way: &mut dyn Connection, user: &User) -> anyhow::Result<()> {
    let Some(name) = user.name.clone() else { return Ok(()) };
    let mut refused = None;
    way.ask(&Question::As { name, role: user.role }, &mut |answer| {
        if let Answer::Failed(failure) = answer {
            refused = Some(failure);
        }
        ControlFlow::Continue(())
    })?;
    refused.map_or(Ok(()), |failure| {
        let text = format!(
            "the manager does not act for a user of this page: {failure}; run `cara web` as its user, and not newer than it"
        );
        Err(Ended::failed(failure.error, text))
    })
}

/// An answer in the form of the page.
fn shown(answer: &Answer) -> Value {
    let mut reported = json!(answer);
    match answer {
        Answer::Called { results, error, .. } => {
            reported["results"] = results.iter().map(form::shown).collect();
            if let Some(said) = error.as_ref().and_then(|error| error.said.as_ref()) {
                reported["error"]["values"] = said.values.iter().map(form::shown).collect();
            }
        }
        Answer::Function(info) => reported["function"] = form::function(info),
        _ => {}
    }
    reported
}

fn failed(failure: &Failure) -> Value {
    json!(Answer::Failed(failure.clone()))
}

/// An error on the way to the manager.
fn failure(error: &anyhow::Error) -> Failure {
    let name = error.downcast_ref::<Ended>().map_or("Failed", |ended| ended.name.as_str());
    let (cause, error, text) = ("transport".to_owned(), name.to_owned(), format!("{error:#}"));
    Failure { cause, error, kind: None, code: None, said: None, text }
}

/// The JSON of a request, whose content has come.
async fn read(body: Body) -> Result<Value, Response> {
    let bytes = to_bytes(body, BODY).await.unwrap_or_default();
    serde_json::from_slice(&bytes)
        .map_err(|error| (StatusCode::BAD_REQUEST, format!("that is no JSON: {error}")).into_response())
}

fn busy(what: &str, most: usize) -> Response {
    let text = format!("{most} {what} run already, which is the most at a time: wait until one has ended");
    lines(&[failed(&Failure::configuration("Busy", text))])
}

fn piece(line: &Value) -> Bytes {
    format!("{line}\n").into()
}

fn lines(lines: &[Value]) -> Response {
    let text: String = lines.iter().map(|line| format!("{line}\n")).collect();
    ([(header::CONTENT_TYPE, "application/x-ndjson")], text).into_response()
}

fn streamed(answers: mpsc::Receiver<Bytes>) -> Response {
    piecewise("application/x-ndjson", answers)
}

impl Shared {
    fn begin_hold(&self, user: Arc<User>) -> u64 {
        let hold = self.next_hold.fetch_add(1, Ordering::Relaxed);
        self.holds().insert(hold, Hold { user, last: Instant::now(), beat: None });
        hold
    }

    fn holds(&self) -> MutexGuard<'_, HashMap<u64, Hold>> {
        self.holds.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_a_failure_keep_all_their_digits() {
        let at = json!({ "name": "at", "size": 1, "type": "int", "value": [9_007_199_254_740_993_i64] });
        let error = json!({ "cause": "peer", "error": "Service", "text": "", "reason": "", "values": [at] });
        let called = json!({ "answer": "called", "node": "a", "id": 1, "results": [], "error": error, "took_us": 1 });
        let reported = shown(&serde_json::from_value(called).unwrap());
        assert_eq!(reported["error"]["values"][0]["value"], json!(["9007199254740993"]));
    }
}
