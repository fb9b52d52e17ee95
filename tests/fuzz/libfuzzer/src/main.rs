//! One program for all targets; the variable `CARA_FUZZ_TARGET` names the one that runs.
#![no_main]

use std::sync::OnceLock;

use cara_fuzz::Target;

static TARGET: OnceLock<&'static Target> = OnceLock::new();

libfuzzer_sys::fuzz_target!(
    init: {
        let name = std::env::var("CARA_FUZZ_TARGET").unwrap_or_default();
        let target = cara_fuzz::TARGETS.iter().chain(cara_fuzz_page::TARGETS).find(|target| target.name == name);
        let target = target.expect("CARA_FUZZ_TARGET names a target");
        TARGET.get_or_init(|| target);
    },
    |data: &[u8]| {
        if let Some(target) = TARGET.get() {
            (target.run)(data);
        }
    }
);
