//! A whole link between two of the core's own sessions: what each end writes, in order.

use cara_core::config::Priority;
use cara_core::distribution::function::Attributes;
use cara_core::distribution::hello::Hello;
use cara_core::distribution::parameters::Parameters;
use cara_core::error::Error;
use cara_core::time::Duration;
use serde_json::{Value, json};

use crate::decoded::{self, hex};
use crate::introductions::{agv_hello, manager_hello};
use crate::side::{How, Side, Written};
use crate::stream;
use crate::vector::{Context, Kind, Vector};

/// What the s_unit offers, by slot.
const POS_INFO: &str = "pos_info() -> (position: int[2])";
const GO_TO: &str = "go_to(position: int[2]) -> (arrived: bool)";
const STOP: &str = "stop()";

/// The s_unit of all conversations, with its functions.
fn agv(hello: Hello) -> Side {
    let leased = Attributes { lease: Some(Duration::from_millis(500)), ..Attributes::default() };
    let urgent = Attributes { priority: Priority::Emergency, idempotent: true, ..Attributes::default() };
    Side::new(hello, true, &[(POS_INFO, Attributes::default()), (GO_TO, leased), (STOP, urgent)])
}

fn manager() -> Side {
    Side::new(manager_hello(), false, &[])
}

/// Both ends after the handshake, the first keep-alives and the publishing of the s_unit's functions.
pub(crate) fn live(hello: Hello) -> (Side, Side) {
    let mut talk = Talk { agv: agv(hello), manager: manager(), vectors: Vec::new() };
    talk.begin();
    (talk.agv, talk.manager)
}

/// Every step of the conversation.
pub(crate) fn all() -> Vec<Vector> {
    let mut talk = Talk { agv: agv(agv_hello()), manager: manager(), vectors: Vec::new() };
    talk.begin();
    talk.blocking_request().unwrap_or_else(|error| panic!("blocking request: {error}"));
    talk.leased_request().unwrap_or_else(|error| panic!("leased request: {error}"));
    talk.emergency().unwrap_or_else(|error| panic!("emergency: {error}"));
    talk.replaced().unwrap_or_else(|error| panic!("replaced function: {error}"));
    talk.end();
    talk.vectors
}

struct Talk {
    agv: Side,
    manager: Side,
    vectors: Vec<Vector>,
}

#[derive(Clone, Copy)]
enum From {
    Agv,
    Manager,
}

impl Talk {
    /// Hands over what one side has written, which must be as many pieces as there are names.
    fn pass(&mut self, from: From, names: &[(&'static str, &'static str)]) {
        let (writer, reader) = match from {
            From::Agv => (&mut self.agv, &mut self.manager),
            From::Manager => (&mut self.manager, &mut self.agv),
        };
        let written = writer.written();
        assert_eq!(written.len(), names.len(), "{names:?}: {written:?}");
        for (piece, names) in written.iter().zip(names) {
            self.vectors.push(step(*names, piece));
            reader.hear(piece);
        }
    }

    fn wait(&mut self, span: Duration) {
        self.agv.wait(span);
        self.manager.wait(span);
    }

    fn begin(&mut self) {
        self.pass(From::Agv, &[("talk_hello_agv", "the s_unit has dialled and introduces itself")]);
        self.pass(From::Manager, &[("talk_hello_manager", "the manager takes it, and ends its list, which is empty")]);
        self.pass(From::Agv, &[("talk_empty_list", "so does the s_unit, which has read the manager's")]);
        self.pass(From::Manager, &[("talk_empty_list_ack", "the manager has read the s_unit's")]);
        self.wait(Duration::from_millis(1));
        self.agv.poll();
        self.manager.poll();
        self.pass(
            From::Agv,
            &[
                ("talk_keep_alive_agv", "the first keep-alive, as a datagram"),
                ("talk_keep_alive_agv_stream", "and in the stream, since no datagram of the peer has come yet"),
            ],
        );
        self.pass(
            From::Manager,
            &[
                ("talk_keep_alive_manager", "the manager's"),
                ("talk_keep_alive_manager_stream", "which it sent before the other's datagram came"),
            ],
        );
        self.agv.poll();
        self.pass(
            From::Agv,
            &[
                ("talk_hears_agv", "the manager's datagram has come, so it tells that at once"),
                ("talk_hears_agv_stream", "and in the stream, since it was not told yet that its own come"),
            ],
        );
        self.manager.poll();
        self.pass(From::Manager, &[("talk_hears_manager", "so does the manager, in a datagram alone: its own come")]);
        self.agv.publish(&[0, 1, 2]);
        self.pass(From::Agv, &[("talk_publish", "the s_unit publishes its functions, and ends the list")]);
        self.pass(From::Manager, &[("talk_list_ack", "the manager has read them")]);
        assert_eq!(self.agv.events.last().map(String::as_str), Some("Acknowledged"));
    }

    fn blocking_request(&mut self) -> Result<(), Error> {
        let mut pos: Parameters = Parameters::new();
        pos.add_int("position", 2)?;
        self.wait(Duration::from_millis(250));
        self.manager.request("pos_info", &pos, How::Blocking)?;
        self.pass(From::Manager, &[("talk_request", "the manager asks for the position")]);
        pos.set_value("position", [3, -4])?;
        let call = self.agv.calls.pop().ok_or(Error::NotConnected)?;
        self.agv.answer(call.ticket, Ok(&pos))?;
        self.pass(From::Agv, &[("talk_reply", "the s_unit answers: 3, -4")]);
        assert_eq!(self.manager.events.last().map(String::as_str), Some("Reply"));
        Ok(())
    }

    fn leased_request(&mut self) -> Result<(), Error> {
        let mut pos: Parameters = Parameters::new();
        pos.add_int("position", 2)?;
        pos.set_value("position", [10, 20])?;
        // A one-way message right behind another write would wait for company.
        self.wait(Duration::from_millis(1));
        self.manager.request("go_to", &pos, How::OneWay)?;
        self.pass(From::Manager, &[("talk_go_to", "a one-way request of a leased function")]);
        self.wait(Duration::from_millis(125));
        self.manager.poll();
        self.pass(
            From::Manager,
            &[
                ("talk_renew", "a quarter of the lease later: renewed, as a datagram"),
                ("talk_renew_stream", "and in the stream"),
            ],
        );
        self.pass(
            From::Agv,
            &[("talk_renewed", "it has been heard"), ("talk_renewed_stream", "which is told on both ways")],
        );
        let call = self.agv.calls.pop().ok_or(Error::NotConnected)?;
        self.agv.answer(call.ticket, Err(cara_core::error::ServiceError::Failed(7).into()))?;
        self.agv.poll();
        self.pass(From::Agv, &[("talk_failure", "the service has failed with code 7, and its lease is ended")]);
        assert_eq!(self.manager.events.last().map(String::as_str), Some("Failed"));
        self.pass(
            From::Manager,
            &[
                ("talk_release", "what has failed is not wanted: released, as a datagram"),
                ("talk_release_stream", "and in the stream"),
            ],
        );
        Ok(())
    }

    fn emergency(&mut self) -> Result<(), Error> {
        let nothing: Parameters = Parameters::new();
        self.manager.request("stop", &nothing, How::OneWay)?;
        self.pass(
            From::Manager,
            &[
                ("talk_stop", "an emergency: in a datagram"),
                ("talk_stop_stream", "and in the stream, with the same id; the second copy is dropped"),
            ],
        );
        assert_eq!(self.agv.calls.len(), 1, "the emergency runs once");
        let call = self.agv.calls.pop().ok_or(Error::NotConnected)?;
        self.agv.answer(call.ticket, Ok(&nothing))?;
        assert!(self.agv.written().is_empty(), "a one-way request that succeeds is not answered");
        Ok(())
    }

    fn replaced(&mut self) -> Result<(), Error> {
        let mut pos: Parameters = Parameters::new();
        pos.add_int("position", 2)?;
        self.agv.replace("pos_info() -> (position: int[3])")?;
        self.manager.request("pos_info", &pos, How::Blocking)?;
        self.pass(From::Manager, &[("talk_stale_request", "of a function that was replaced")]);
        self.pass(From::Agv, &[("talk_stale_reply", "it is not run; the news follow")]);
        self.pass(From::Manager, &[("talk_list_ack_again", "which are acknowledged")]);
        Ok(())
    }

    fn end(&mut self) {
        self.manager.stop();
        self.pass(From::Manager, &[("talk_close", "the manager is stopped")]);
        self.agv.poll();
        assert_eq!(self.agv.events.last().map(String::as_str), Some("Closed"));
    }
}

/// A piece of a conversation as a vector. Its value is what the session wrote it for, so nothing is expected beside it.
fn step(names: (&'static str, &'static str), piece: &Written) -> Vector {
    match piece {
        Written::Stream(bytes) => {
            let context = Context::limits(4096, 32_800);
            let value = stream::decode(&context, bytes);
            assert!(
                !hex(bytes).is_empty() && value.as_array().is_some_and(|seen| seen.iter().all(is_sound)),
                "{value}"
            );
            Vector::new(names, Kind::Stream, context, bytes, &value)
        }
        Written::Datagram(bytes) => {
            let value = decoded::datagram(7, bytes).unwrap_or_else(|| panic!("{names:?} is unreadable"));
            Vector::new(names, Kind::Datagram, Context::fleet(7), bytes, &value)
        }
    }
}

fn is_sound(seen: &Value) -> bool {
    ["violation", "incomplete", "unreadable"].iter().all(|word| seen.get(word).is_none()) && *seen != json!(null)
}
