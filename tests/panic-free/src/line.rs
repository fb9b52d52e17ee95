//! A serial line.

use cara_core::host::line::Line;

use crate::linkage::{keep, unknown, unknown_slice};

entry!(line_made, {
    keep(Line::new(*unknown(), *unknown()));
});

entry!(line_polled, {
    let line: &mut Line = unknown();
    keep(line.receive(unknown_slice(), *unknown()));
    keep(line.transmit(*unknown(), unknown()));
    keep((line.deadline(), line.state(), line.counters()));
});

entry!(line_stream, {
    let line: &mut Line = unknown();
    keep((line.dial(*unknown()), line.accept()));
    keep((line.capacity(), line.write(unknown_slice())));
    keep(line.peek());
    line.take(*unknown());
    line.close(*unknown());
    line.abort();
});

entry!(line_datagrams, {
    let line: &mut Line = unknown();
    keep(line.send_datagram(*unknown(), *unknown(), unknown_slice()));
    keep((line.has_datagram(), line.next_datagram()));
});
