//! Time, randomness, storage, errors.

use cara_core::config::{Constraints, Priority};
use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::error::Error;
use cara_core::random::Random;
use cara_core::storage::{Buffers, Lent, Pool};
use cara_core::time::{Duration, Instant};

use crate::linkage::{keep, unknown, unknown_slice};
use crate::secure::AnyCodes;

entry!(instants, {
    let now = Instant::from_micros(*unknown());
    let span = Duration::from_micros(*unknown());
    keep((now + span, now - span, now.since(*unknown()), now.as_micros()));
});

entry!(durations, {
    let (one, other) = (*unknown::<Duration>(), *unknown::<Duration>());
    keep((one + other, one - other, one.times(*unknown()), one.divided_by(*unknown())));
    keep((one.as_wire(), one.as_millis(), one.as_micros()));
    keep((Duration::from_millis(*unknown()), Duration::from_secs(*unknown())));
    let converted: core::time::Duration = one.into();
    keep((converted, Duration::from(*unknown::<core::time::Duration>())));
});

entry!(random, {
    let mut random = Random::new(*unknown());
    keep((random.bits(), random.below(*unknown()), random.jitter(*unknown())));
});

entry!(claims, {
    let (one, other) = (*unknown::<Claim>(), *unknown::<Claim>());
    keep((one > other, one.raised(*unknown()), one.tagged(unknown(), &AnyCodes)));
    keep(unknown::<TaggedClaim>().is_genuine(unknown(), &AnyCodes));
});

entry!(pools, {
    let mut pool: Pool<Lent> = Pool::new(unknown_slice());
    keep((pool.take(), pool.take_leaving(*unknown()), pool.free()));
    pool.give(unknown_slice());
    keep(pool);
});

entry!(errors, {
    keep(unknown::<Error>().cause());
});

entry!(priorities, {
    keep((Priority::from_wire(*unknown()), unknown::<Priority>().to_wire(), unknown::<Priority>().word()));
    keep((Constraints::M_UNIT, Constraints::S_UNIT));
});
