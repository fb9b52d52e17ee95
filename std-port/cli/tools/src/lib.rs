//! What all verbs of the `cara` command share: the options that each of them has, what it prints, and how it ends.

pub mod close_names;
pub mod exit;
pub mod files;
pub mod global;
pub mod interrupt;
pub mod keys;
pub mod listening;
pub mod name_and_id;
pub mod output;
pub mod units;
