//! More connections than there are places, of those that are slow on purpose or by a bad network. A stop still goes through.

use std::time::Instant;

use cara_processes::ticker::Ticker;

use super::*;
use crate::limits::CONNECTIONS;
use crate::lines::HEAD;

/// How long a stop takes at most, however many connections are open, besides what the host holds this process up. If it waited for
/// the others, it would take what is left of their [`HEAD`], which began just before, or more.
const STOPPED: Duration = HEAD.saturating_sub(Duration::from_secs(2));

/// A stop of all over a connection of its own. How long it took.
fn stop(stage: &Stage) -> Duration {
    let (started, ticker) = (Instant::now(), Ticker::start());
    let text = stage.answer("POST", "/api/stop", &[], "{\"node\":null}");
    let (took, held_up) = (started.elapsed(), ticker.together());
    assert!(starts(&text, 200) && text.contains("NoStop"), "after {took:?}: {text:?}");
    assert!(took < STOPPED + held_up, "it took {took:?}, with {held_up:?} of the host's");
    took
}

/// Stops, again after each slow byte of the others.
fn stops_beside(stage: &Stage, crowd: &mut [TcpStream], byte: &[u8]) {
    for _ in 0..3 {
        let took = stop(stage);
        println!("stopped after {took:?} beside {} connections", crowd.len());
        // Those that gave way are closed.
        crowd.iter_mut().for_each(|stream| drop(stream.write_all(byte)));
    }
}

/// Waits until the page shows that a limit has refused so often.
fn refused(stage: &Stage, name: &str, least: u64) {
    soon(|| {
        let mut stream = stage.send("GET", "/api/stream", &[], "");
        let (mut text, mut piece) = (Vec::new(), [0; 4096]);
        // As long as there are too many requests it says nothing of limits.
        while let Ok(read @ 1..) = stream.read(&mut piece) {
            text.extend_from_slice(&piece[..read]);
            let reported = String::from_utf8_lossy(&text);
            let message = reported.split_once("data: ").and_then(|(_, message)| message.split_once("\n\n"));
            let Some((message, _)) = message else { continue };
            let message: Value = serde_json::from_str(message).unwrap();
            let Some(limits) = message["limits"]["rows"][""].as_array() else { return false };
            let limit = limits.iter().find(|limit| limit["name"].as_str().unwrap().contains(name));
            return limit.unwrap_or_else(|| panic!("{name} is not shown"))["refused"].as_u64().unwrap() >= least;
        }
        false
    });
}

fn connections(stage: &Stage, count: usize, first: &str) -> Vec<TcpStream> {
    let open = |_| {
        let mut stream = TcpStream::connect(stage.address).unwrap();
        stream.write_all(first.as_bytes()).unwrap();
        stream
    };
    (0..count).map(open).collect()
}

#[test]
fn a_stop_goes_through_beside_slow_heads() {
    let stage = stage();
    let mut crowd = connections(&stage, CONNECTIONS, "POST /api/stop HTTP/1.1\r\nhost: localhost\r\nx-slow: ");
    stops_beside(&stage, &mut crowd, b"a");
    refused(&stage, "gave way", 1);
}

#[test]
fn a_stop_goes_through_beside_idle_connections() {
    let stage = stage();
    let mut crowd = connections(&stage, CONNECTIONS * 2, "");
    stops_beside(&stage, &mut crowd, b"");
    refused(&stage, "gave way", 1);
}

#[test]
fn a_stop_goes_through_beside_slow_contents() {
    let stage = stage();
    let with = |path: &str, token: &str| {
        format!(
            "POST {path} HTTP/1.1\r\nhost: {0}\r\norigin: http://{0}\r\nx-cara: 1\r\n{token}content-length: 500\r\n\r\n",
            stage.address
        )
    };
    let mut crowd = connections(&stage, CONNECTIONS, &with("/api/call", ""));
    stops_beside(&stage, &mut crowd, b"{");
    drop(crowd);
    // The same by pages with the token.
    for path in ["/api/call", "/api/stop", "/api/ready"] {
        let mut crowd = connections(&stage, CONNECTIONS, &with(path, &format!("authorization: Bearer {TOKEN}\r\n")));
        stops_beside(&stage, &mut crowd, b"{");
    }
    let token = format!("authorization: Bearer {TOKEN}\r\n");
    let _crowd = connections(&stage, 3, &with("/api/stop", &token));
    refused(&stage, "content did not come", 3);
}

#[test]
fn a_stop_goes_through_beside_more_pages_than_are_served() {
    let stage = stage();
    let token = format!("authorization: Bearer {TOKEN}\r\n");
    let follow = format!("GET /api/stream HTTP/1.1\r\nhost: {}\r\n{token}\r\n", stage.address);
    let mut crowd = connections(&stage, CONNECTIONS, &follow);
    stops_beside(&stage, &mut crowd, b"");
    drop(crowd);
    // As many questions as run at a time, each of which waits for the one before.
    let mut crowd = Vec::new();
    soon(|| {
        let mut stream = stage.send("POST", "/api/functions", &[], "{\"node\":\"hung\"}");
        stream.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        let mut first = [0; 12];
        let is_refused = stream.read_exact(&mut first).is_ok() && &first == b"HTTP/1.1 503";
        crowd.push(stream);
        is_refused
    });
    stops_beside(&stage, &mut crowd, b"");
    drop(crowd);
    refused(&stage, "besides stops", 1);
}

/// Each is carried out: none is told that there are too many.
#[test]
fn all_stops_get_their_turn() {
    let stage = stage();
    let crowd: Vec<_> = (0..CONNECTIONS)
        .map(|number| {
            let node = if number % 2 == 0 { "null" } else { "\"agv/1\"" };
            stage.send("POST", "/api/stop", &[], &format!("{{\"node\":{node}}}"))
        })
        .collect();
    for mut stream in crowd {
        let mut text = String::new();
        let _ = stream.read_to_string(&mut text);
        assert!(text.contains("NoStop"), "{text}");
    }
}

#[test]
fn a_head_has_seconds_as_a_whole_and_so_has_a_connection_that_asks_nothing() {
    let stage = stage();
    let started = Instant::now();
    let mut slow = connections(&stage, 1, "GET / HTTP/1.1\r\nhost: localhost\r\nx-slow: ");
    let mut idle = connections(&stage, 1, "");
    // Each byte would have begun the time anew.
    while slow[0].write_all(b"a").is_ok() {
        assert!(started.elapsed() < PATIENCE);
        std::thread::sleep(Duration::from_millis(200));
    }
    assert!(started.elapsed() >= Duration::from_secs(4), "a head may take some time: {:?}", started.elapsed());
    idle[0].set_read_timeout(Some(PATIENCE)).unwrap();
    assert!(matches!(idle[0].read(&mut [0]), Ok(0) | Err(_)));
    assert!(started.elapsed() < PATIENCE);
    refused(&stage, "requests that did not come", 2);
}

/// A page that takes nothing has a place as long as that takes to be seen.
#[test]
fn a_browser_that_takes_nothing_is_given_up() {
    let stage = stage();
    let mut crowd: Vec<_> = (0..8)
        .map(|_| {
            let stream = TcpStream::connect(stage.address).unwrap();
            stream.set_write_timeout(Some(PATIENCE)).unwrap();
            stream
        })
        .collect();
    let file = format!("GET /map.js HTTP/1.1\r\nhost: {}\r\n\r\n", stage.address);
    // So many answers that no buffer of the system takes them.
    let many = file.repeat(20_000);
    let started = Instant::now();
    std::thread::scope(|scope| {
        crowd.iter_mut().for_each(|stream| drop(scope.spawn(|| drop(stream.write_all(many.as_bytes())))));
        println!("stopped after {:?}", stop(&stage));
    });
    assert!(started.elapsed() < PATIENCE);
    stop(&stage);
    refused(&stage, "took nothing", 8);
}
