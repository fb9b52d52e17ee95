//! Calls as text: `go_to(position: [1, 2])`, read against a published signature and written so that they can be read
//! again.
//!
//! A call is a function's name, and behind it its arguments in parentheses, by name, parted by commas; without
//! parentheses there are none. A value is
//! - a whole number: `7`, `-7`, `0x1F`, for `int`; also for `float`,
//! - a number with a fraction: `0.5`, `1e-3`, `NaN`, `inf`, `-inf`, for `float`,
//! - `true` or `false`, for `bool`,
//! - text in double quotes with the escapes of JSON, for `string`,
//! - bytes as `0x` and two hexadecimal digits each, for `bytes`,
//! - several of the first three in brackets, as `[1, 2]`, where the signature has a size other than 1,
//! - `null`, or nothing at all, for an optional value that is absent.

mod bind;
mod interface;
mod mistake;
mod print;
mod read;

pub(crate) use bind::bind;
pub(crate) use interface::interface;
pub(crate) use mistake::Mistake;
pub(crate) use print::show_call;
pub(crate) use read::{Written, read};

#[cfg(test)]
mod tests;
