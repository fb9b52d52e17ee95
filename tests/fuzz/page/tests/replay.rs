//! Each input of the corpus, and each that has made the target panic, is run again.

#[test]
fn every_input_that_was_found_is_run_again() {
    cara_fuzz::replay(env!("CARGO_MANIFEST_DIR").as_ref(), cara_fuzz_page::TARGETS);
    let taken = cara_fuzz_page::taken();
    assert!(taken.iter().all(|taken| *taken > 3), "only so many requests and calls were taken: {taken:?}");
}
