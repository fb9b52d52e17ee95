//! The built `cara` command against a manager in a process of its own and AGVs on loopback, in a fleet of their own.

mod access;
mod alone;
mod bundle;
mod calls;
mod constraints;
mod documents;
mod failing;
mod giving_up;
mod handing;
mod holding;
mod hung;
mod logging;
mod managers;
mod measuring;
mod places;
mod recording;
mod roles;
mod scanning;
mod screens;
mod standing_by;
mod stopping;
mod streaming;
mod support;
mod terminal;
mod watching;
