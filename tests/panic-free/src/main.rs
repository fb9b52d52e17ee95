//! Calls every public entry point of the core with values that the compiler cannot know.
//!
//! The panic handler calls a symbol that nothing defines: the binary links only if the optimiser finds every panic
//! unreachable. It is never run.
#![no_std]
#![no_main]

#[macro_use]
mod linkage;

mod calls;
mod distribution;
mod foundation;
mod host;
mod line;
mod messages;
mod nested;
mod node;
mod secure;
mod services;
mod shown;

#[cfg(feature = "planted")]
entry!(planted, {
    if *linkage::unknown::<u32>() == 7 {
        panic!("this panic is reachable");
    }
});
