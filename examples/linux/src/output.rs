//! Standard output, a line at a time.

/// Prints a line. Where nobody reads any more, the example goes on: an AGV must not end because its terminal closed.
#[macro_export]
macro_rules! say {
    ($($text:tt)*) => {{
        use ::std::io::Write as _;
        let _ = ::std::writeln!(::std::io::stdout().lock(), $($text)*);
    }};
}
