//! Log lines through `tracing`, `defmt` or nothing, chosen by feature. One line per transition, none per message.

#[allow(unused_macros)]
macro_rules! debug {
    ($($arg:tt)*) => {{
        #[cfg(feature = "tracing")]
        ::tracing::debug!($($arg)*);
        #[cfg(feature = "defmt")]
        ::defmt::debug!($($arg)*);
        #[cfg(not(any(feature = "tracing", feature = "defmt")))]
        { let _ = ::core::format_args!($($arg)*); }
    }};
}

#[allow(unused_macros)]
macro_rules! warning {
    ($($arg:tt)*) => {{
        #[cfg(feature = "tracing")]
        ::tracing::warn!($($arg)*);
        #[cfg(feature = "defmt")]
        ::defmt::warn!($($arg)*);
        #[cfg(not(any(feature = "tracing", feature = "defmt")))]
        { let _ = ::core::format_args!($($arg)*); }
    }};
}
