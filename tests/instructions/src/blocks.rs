//! Messages alone: a request made of parameters, and parameters made of a request.

use core::hint::black_box;

use cara_core::distribution::block::{self, SliceWriter};
use cara_core::distribution::function::Definition;
use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::message::{Message, REQUEST_BYTES, RequestHeader};
use cara_core::distribution::parameters::ParametersView;
use cara_core::time::Duration;

use crate::{Meter, Of, Operation};

/// A message and both ends' parameters.
pub struct Blocks {
    definition: Definition,
    text: &'static str,
    sender: &'static mut ParametersView,
    receiver: &'static mut ParametersView,
    message: &'static mut [u8],
    length: usize,
}

impl Blocks {
    /// A request with two integers.
    pub fn ints(parameters: [&'static mut ParametersView; 2], message: &'static mut [u8]) -> Self {
        let [sender, receiver] = parameters;
        sender.add_int("position", 2).expect("room for two integers");
        sender.set_value("position", [3, 4]).expect("two integers");
        let definition = Definition::parse("go_to(position: int[2])").expect("a signature");
        Self { definition, text: "", sender, receiver, message, length: 0 }
    }

    /// A request with a text of so many characters.
    pub fn text(
        parameters: [&'static mut ParametersView; 2],
        message: &'static mut [u8],
        characters: &'static mut [u8],
    ) -> Self {
        let [sender, receiver] = parameters;
        let length = characters.len();
        let text = crate::text(characters, length);
        sender.add_string("text", length as u32).expect("room for the text");
        sender.set_value("text", text).expect("the text");
        let definition = Definition::new("echo").and_then(|echo| echo.arguments(sender)).expect("a signature");
        Self { definition, text, sender, receiver, message, length: 0 }
    }

    fn encode(&mut self) {
        let header = RequestHeader {
            id: black_box(7),
            slot: Slot(1),
            generation: Generation(1),
            wants_reply: true,
            wants_progress: false,
            takes_over: false,
            operator: false,
            unknown: 0,
            remaining: Duration::from_millis(500),
            stamp: 1_000_000,
            since: Duration::from_millis(20),
            number: 3,
        };
        let arguments = self.definition.signature().arguments();
        block::measure(arguments, self.sender).expect("the parameters match");
        let (head, body) = self.message.split_at_mut(REQUEST_BYTES);
        head.copy_from_slice(&header.encode());
        let mut writer = SliceWriter::new(body);
        block::write(arguments, self.sender, &mut writer);
        self.length = REQUEST_BYTES + writer.written();
    }

    fn decode(&mut self) {
        let Some(Message::Request(header, block)) = Message::decode(&self.message[..self.length]) else {
            panic!("it is a request")
        };
        black_box(header.id);
        let arguments = self.definition.signature().arguments();
        block::read_arguments(arguments, block, self.receiver).expect("what was encoded");
    }

    /// Two messages made from a program's text, as the two ends of a round trip do.
    fn generate(&mut self) {
        for _ in 0..2 {
            self.sender.set_value("text", black_box(self.text)).expect("the text");
            self.encode();
        }
    }

    /// Two messages read, up to the text that a program sees.
    fn process(&mut self) {
        for _ in 0..2 {
            self.decode();
            black_box(self.receiver.variable::<&str>("text").expect("the text"));
        }
    }

    /// What can be counted with two integers.
    pub fn operations_with_ints() -> [Operation<Self>; 2] {
        Self::both(Of::Ints(2))
    }

    /// What can be counted with a text. Generating and processing are a whole round trip's, both messages.
    pub fn operations_with_text(characters: u32) -> [Operation<Self>; 4] {
        let of = Of::Characters(characters);
        let [encode, decode] = Self::both(of);
        [
            encode,
            decode,
            Operation {
                name: "round trip, generating",
                of,
                run: |blocks, meter| meter.count(&mut || blocks.generate()),
            },
            Operation {
                name: "round trip, processing",
                of,
                run: |blocks, meter| {
                    blocks.encode();
                    meter.count(&mut || blocks.process());
                },
            },
        ]
    }

    fn both(of: Of) -> [Operation<Self>; 2] {
        let decode = |blocks: &mut Self, meter: &mut dyn Meter| {
            blocks.encode();
            meter.count(&mut || blocks.decode());
        };
        [
            Operation { name: "encode", of, run: |blocks, meter| meter.count(&mut || blocks.encode()) },
            Operation { name: "decode", of, run: decode },
        ]
    }
}
