//! The operator's way in (design, section 7): a running m_unit answers questions on a Unix socket that only its owner
//! can open.

pub mod protocol;
