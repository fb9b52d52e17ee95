//! Wrong use is told in words, at the place that is wrong. `TRYBUILD=overwrite` writes what is told now.
//!
//! All cases are one call of cargo, and use the core alone: nothing else is built for them. Most errors are the macros' own; the
//! few that rustc words may read otherwise with another compiler.

#[test]
fn wrong_use_is_a_readable_error() {
    trybuild::TestCases::new().compile_fail("tests/wrong/*.rs");
}
