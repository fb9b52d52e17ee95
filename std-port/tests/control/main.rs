//! The control socket of a running m_unit, from its client's side and below it.

mod asking;
mod audit;
mod calling;
mod clients;
mod everybody;
mod frozen;
mod hearts;
#[path = "../keyed/mod.rs"]
mod keyed;
mod operator;
mod origin;
mod places;
mod roles;
mod support;
