//! Distribution: what travels between two units, read and written.

use cara_core::distribution::block::{self, SliceWriter};
use cara_core::distribution::function::VariableSpecs;
use cara_core::distribution::message::{self, Control, Message, RequestHeader, SampleHeader, SessionBody};
use cara_core::distribution::parameters::{Parameters, ParametersView};

use crate::linkage::{keep, unknown, unknown_slice};

fn specs() -> VariableSpecs<'static> {
    *unknown()
}

fn parameters() -> &'static mut ParametersView {
    unknown::<Parameters<64>>()
}

entry!(messages_read, {
    keep(Message::decode(unknown_slice()));
    keep(SessionBody::decode(unknown_slice()));
});

entry!(messages_written, {
    keep(unknown::<RequestHeader>().encode());
    keep((message::encode_reply(*unknown(), *unknown()), message::encode_failure(*unknown(), *unknown())));
    keep(unknown::<Control<'static>>().encode(unknown_slice()));
    keep((SessionBody::keep_alive(*unknown(), *unknown()), SessionBody::renewal(unknown())));
    keep((SessionBody::pong(*unknown()), SessionBody::close(*unknown())));
    keep((SessionBody::release(unknown()), SessionBody::release_all(*unknown(), *unknown())));
    keep(SessionBody::renewed(*unknown()));
    keep(unknown::<SampleHeader>().encode());
    keep(SessionBody::message_prefix(*unknown()));
});

entry!(blocks_written, {
    keep((block::measure(specs(), parameters()), block::longest(specs())));
    let mut writer = SliceWriter::new(unknown_slice());
    block::write(specs(), parameters(), &mut writer);
    keep(writer.written());
});

entry!(blocks_read, {
    keep(block::check(specs(), unknown_slice()));
    block::values(specs(), unknown_slice()).for_each(keep);
    keep(block::check_results_fit(specs(), parameters()));
    keep(block::read(specs(), unknown_slice(), parameters()));
    keep(block::read_arguments(specs(), unknown_slice(), parameters()));
    keep(block::prepare_results(specs(), parameters()));
});
