//! Each input of the corpora, and each that has made a target panic, is run again.

#[test]
fn every_input_that_was_found_is_run_again() {
    cara_fuzz::replay(env!("CARGO_MANIFEST_DIR").as_ref(), cara_fuzz::TARGETS);
}
