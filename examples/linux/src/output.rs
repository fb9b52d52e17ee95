//! Standard output, a line at a time.

/// Prints a line. A closed standard output is not an error: an AGV must not end because its terminal closed.
#[macro_export]
macro_rules! say {
    ($($text:tt)*) => {{
        use ::std::io::Write as _;
        let _ = ::std::writeln!(::std::io::stdout().lock(), $($text)*);
    }};
}
