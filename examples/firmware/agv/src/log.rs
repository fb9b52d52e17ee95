//! Log lines of boards: through `defmt` where the crate that writes one has its feature `defmt`, else nothing.

/// A line of level info. Arguments are looked at in any case, and need no format where nothing is logged.
#[macro_export]
macro_rules! info {
    ($text:literal $(, $argument:expr)* $(,)?) => {{
        #[cfg(feature = "defmt")]
        ::defmt::info!($text $(, $argument)*);
        #[cfg(not(feature = "defmt"))]
        { $( let _ = &$argument; )* }
    }};
}

/// A line of level error, likewise.
#[macro_export]
macro_rules! error {
    ($text:literal $(, $argument:expr)* $(,)?) => {{
        #[cfg(feature = "defmt")]
        ::defmt::error!($text $(, $argument)*);
        #[cfg(not(feature = "defmt"))]
        { $( let _ = &$argument; )* }
    }};
}
