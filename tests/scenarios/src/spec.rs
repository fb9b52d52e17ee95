//! A unit as a scenario describes it, before a port makes it.

use cara_core::config::Constraints;
use cara_core::distribution::identity::Identity;

use crate::Service;

/// What a unit is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SpecRole {
    /// An m_unit.
    Manager,
    /// An s_unit of the manager with this name and id.
    Agv(String, u32),
}

/// A unit to be added to a world. It is started at once, and again with the same services after a restart.
#[derive(Clone)]
pub struct Spec {
    pub(crate) role: SpecRole,
    pub(crate) name: String,
    pub(crate) id: u32,
    pub(crate) fleet: u32,
    pub(crate) constraints: Constraints,
    pub(crate) services: Vec<Service>,
    pub(crate) streams: Vec<&'static str>,
    pub(crate) published: bool,
    pub(crate) their_functions: usize,
    pub(crate) message_buffers: usize,
    pub(crate) one_call_at_a_time: bool,
    pub(crate) same_seed: bool,
    pub(crate) beside_another: bool,
    pub(crate) takes_over: bool,
    pub(crate) m_units: Option<Vec<(&'static str, u32)>>,
}

impl Spec {
    /// An m_unit.
    pub fn manager(name: &str, id: u32) -> Self {
        Self::new(SpecRole::Manager, name, id, Constraints::M_UNIT)
    }

    /// An s_unit that joins the m_unit `manager` with id 1.
    pub fn agv(name: &str, id: u32) -> Self {
        Self::new(SpecRole::Agv("manager".to_owned(), 1), name, id, Constraints::S_UNIT)
    }

    fn new(role: SpecRole, name: &str, id: u32, constraints: Constraints) -> Self {
        Self {
            role,
            name: name.to_owned(),
            id,
            fleet: 0,
            constraints,
            services: Vec::new(),
            streams: Vec::new(),
            published: true,
            their_functions: 48,
            message_buffers: 32,
            one_call_at_a_time: false,
            same_seed: false,
            beside_another: false,
            takes_over: false,
            m_units: None,
        }
    }

    /// A manager that starts although one of its identity is there.
    pub fn beside_another(self) -> Self {
        Self { beside_another: true, ..self }
    }

    /// A manager that takes over from a live one of its identity, with the second term.
    pub fn takes_over(self) -> Self {
        Self { takes_over: true, ..self }
    }

    /// The m_units that an m_unit connects to, instead of all.
    pub fn m_units(self, m_units: &[(&'static str, u32)]) -> Self {
        Self { m_units: Some(m_units.to_vec()), ..self }
    }

    /// The manager that an s_unit joins instead.
    pub fn joins(self, name: &str, id: u32) -> Self {
        Self { role: SpecRole::Agv(name.to_owned(), id), ..self }
    }

    /// Of each peer one call runs at a time, and all others wait for it.
    pub fn one_call_at_a_time(self) -> Self {
        Self { one_call_at_a_time: true, ..self }
    }

    /// Another fleet within the scenario.
    pub fn fleet(self, fleet: u32) -> Self {
        Self { fleet, ..self }
    }

    /// A service that it has from the start.
    pub fn service(mut self, service: &Service) -> Self {
        self.services.push(service.clone());
        self
    }

    /// A stream in its text form that it has from the start.
    pub fn stream(mut self, stream: &'static str) -> Self {
        self.streams.push(stream);
        self
    }

    /// Its services are not published at the start.
    pub fn unpublished(self) -> Self {
        Self { published: false, ..self }
    }

    /// Changes its limits.
    pub fn limits(mut self, change: impl FnOnce(&mut Constraints)) -> Self {
        change(&mut self.constraints);
        self
    }

    /// Its identity.
    pub(crate) fn identity(&self) -> Identity {
        let identity = match self.role {
            SpecRole::Manager => Identity::m_unit(&self.name, self.id),
            SpecRole::Agv(..) => Identity::s_unit(&self.name, self.id),
        };
        identity.expect("a short name")
    }

    /// Functions that it keeps of each peer's list.
    pub fn their_functions(self, count: usize) -> Self {
        Self { their_functions: count, ..self }
    }

    /// Message buffers that all its links share.
    pub fn message_buffers(self, count: usize) -> Self {
        Self { message_buffers: count, ..self }
    }

    /// Each of its lives draws the same random numbers, as a board without a source of noise does.
    pub fn same_seed(self) -> Self {
        Self { same_seed: true, ..self }
    }
}
