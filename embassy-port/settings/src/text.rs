//! Settings as text: words of the form `field=value`, with spaces between them.
//!
//! ```
//! use cara_settings::Settings;
//!
//! let settings: Settings = "name=agv-17 id=17 manager=depot/1 fleet=7 address=10.0.0.17/24 gateway=10.0.0.1".parse()?;
//! assert_eq!(settings.identity.name(), "agv-17");
//! assert_eq!(settings.to_string().parse(), Ok(settings));
//! # Ok::<(), cara_settings::TextError>(())
//! ```
//!
//! `address=dhcp` is the default, as are fleet 0, no gateway, and links that are secured (`insecure=yes` makes them plain); a unit without `manager` is an m_unit;
//! `manager_address=10.0.0.1:4000` replaces broadcasts. Names with spaces cannot be written so; an access point is no
//! part of it, because its password is secret.

use core::fmt;
use core::net::SocketAddrV4;
use core::str::FromStr;

use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Fleet, Identity, Role};

use crate::{Network, Settings, is_of_host};

/// A word of the text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Field {
    /// `name=agv-17`
    Name,
    /// `id=17`
    Id,
    /// `manager=depot/1`
    Manager,
    /// `manager_address=10.0.0.1:4000`
    ManagerAddress,
    /// `fleet=7`
    Fleet,
    /// `address=dhcp` or `address=10.0.0.17/24`
    Address,
    /// `gateway=10.0.0.1`
    Gateway,
    /// `insecure=yes`: plain mode, without keys.
    Insecure,
    /// `keys=` and digits: the keys, which are no part of the settings and are never shown.
    Keys,
}

impl Field {
    const ALL: [Self; 9] = [
        Self::Name,
        Self::Id,
        Self::Manager,
        Self::ManagerAddress,
        Self::Fleet,
        Self::Address,
        Self::Gateway,
        Self::Insecure,
        Self::Keys,
    ];

    const fn word(self) -> &'static str {
        match self {
            Self::Name => "name",
            Self::Id => "id",
            Self::Manager => "manager",
            Self::ManagerAddress => "manager_address",
            Self::Fleet => "fleet",
            Self::Address => "address",
            Self::Gateway => "gateway",
            Self::Insecure => "insecure",
            Self::Keys => "keys",
        }
    }

    const fn form(self) -> &'static str {
        match self {
            Self::Name => "1 to 32 bytes without control characters",
            Self::Id | Self::Fleet => "a number of 32 bits",
            Self::Manager => "the manager's NAME/ID",
            Self::ManagerAddress => "the ADDRESS:PORT of a host",
            Self::Address => "dhcp, or a host's ADDRESS/BITS as in 10.0.0.17/24",
            Self::Gateway => "a host's IPv4 address; with address=ADDRESS/BITS only",
            Self::Insecure => "yes; leave it away for a board with keys",
            Self::Keys => "hexadecimal digits, as `cara provision` writes them",
        }
    }
}

impl fmt::Display for Field {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

/// What is wrong with a text.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TextError {
    /// A word that is no `field=value`, or of a field that does not exist.
    #[error(
        "word {0} is no field=value: fields are name, id, manager, manager_address, fleet, address, gateway, insecure and keys"
    )]
    Word(usize),
    /// The same field twice.
    #[error("{0} stands there twice")]
    Twice(Field),
    /// A value of another form.
    #[error("{0} is not {form}", form = .0.form())]
    Value(Field),
    /// A field that must be there.
    #[error("{0} is missing: {form}", form = .0.form())]
    Missing(Field),
}

impl FromStr for Settings {
    type Err = TextError;

    fn from_str(text: &str) -> Result<Self, TextError> {
        let words = Words::of(text)?;
        let name = words.required(Field::Name)?;
        let id = number(Field::Id, words.required(Field::Id)?)?;
        let manager = words.of_field(Field::Manager).map(manager).transpose()?;
        let role = if manager.is_some() { Role::SUnit } else { Role::MUnit };
        let identity = Identity::new(name, id, role).map_err(|_| TextError::Value(Field::Name))?;
        let fleet = words.of_field(Field::Fleet).map_or(Ok(0), |word| number(Field::Fleet, word))?;
        let manager_address =
            words.parsed(Field::ManagerAddress, |address: &SocketAddrV4| is_of_host(*address.ip()))?;
        let insecure = match words.of_field(Field::Insecure) {
            None => false,
            Some("yes") => true,
            Some(_) => return Err(TextError::Value(Field::Insecure)),
        };
        let network = network(&words)?;
        Ok(Self { identity, manager, manager_address, fleet: Fleet(fleet), network, wifi: None, insecure })
    }
}

/// The value of one field.
#[cfg(feature = "keys")]
pub(crate) fn value_of(text: &str, field: Field) -> Result<Option<&str>, TextError> {
    Words::of(text).map(|words| words.of_field(field))
}

/// The values of a text, by field.
struct Words<'t>([Option<&'t str>; Field::ALL.len()]);

impl<'t> Words<'t> {
    fn of(text: &'t str) -> Result<Self, TextError> {
        let mut words = Self([None; Field::ALL.len()]);
        for (position, word) in text.split_whitespace().enumerate() {
            let (name, value) = word.split_once('=').ok_or(TextError::Word(position + 1))?;
            let fields = words.0.iter_mut().zip(Field::ALL);
            let (place, field) =
                fields.into_iter().find(|(_, field)| field.word() == name).ok_or(TextError::Word(position + 1))?;
            if place.replace(value).is_some() {
                return Err(TextError::Twice(field));
            }
        }
        Ok(words)
    }

    fn of_field(&self, field: Field) -> Option<&'t str> {
        self.0.iter().zip(Field::ALL).find(|(_, one)| *one == field).and_then(|(value, _)| *value)
    }

    fn required(&self, field: Field) -> Result<&'t str, TextError> {
        self.of_field(field).ok_or(TextError::Missing(field))
    }

    fn parsed<T: FromStr>(&self, field: Field, is_sound: impl Fn(&T) -> bool) -> Result<Option<T>, TextError> {
        let parsed = |value: &str| value.parse().ok().filter(&is_sound).ok_or(TextError::Value(field));
        self.of_field(field).map(parsed).transpose()
    }
}

fn number(field: Field, value: &str) -> Result<u32, TextError> {
    value.parse().map_err(|_| TextError::Value(field))
}

fn manager(value: &str) -> Result<Manager, TextError> {
    let wrong = TextError::Value(Field::Manager);
    let (name, id) = value.rsplit_once('/').ok_or(wrong)?;
    Manager::new(name, id.parse().map_err(|_| wrong)?).map_err(|_| wrong)
}

fn network(words: &Words<'_>) -> Result<Network, TextError> {
    let wrong = TextError::Value(Field::Address);
    let gateway = words.parsed(Field::Gateway, |address| is_of_host(*address))?;
    match words.of_field(Field::Address) {
        None | Some("dhcp") if gateway.is_some() => Err(TextError::Value(Field::Gateway)),
        None | Some("dhcp") => Ok(Network::Dhcp),
        Some(value) => {
            let (address, prefix) = value.split_once('/').ok_or(wrong)?;
            let address = address.parse().ok().filter(|address| is_of_host(*address)).ok_or(wrong)?;
            let prefix = prefix.parse().ok().filter(|&prefix| prefix <= 32).ok_or(wrong)?;
            Ok(Network::Static { address, prefix, gateway })
        }
    }
}

impl fmt::Display for Settings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "name={} id={}", self.identity.name(), self.identity.id())?;
        if let Some(manager) = &self.manager {
            write!(f, " manager={}/{}", manager.name, manager.id)?;
        }
        if let Some(address) = self.manager_address {
            write!(f, " manager_address={address}")?;
        }
        write!(f, " fleet={}", self.fleet.0)?;
        match self.network {
            Network::Dhcp => f.write_str(" address=dhcp")?,
            Network::Static { address, prefix, gateway: None } => write!(f, " address={address}/{prefix}")?,
            Network::Static { address, prefix, gateway: Some(gateway) } => {
                write!(f, " address={address}/{prefix} gateway={gateway}")?;
            }
        }
        if self.insecure { f.write_str(" insecure=yes") } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::net::Ipv4Addr;
    use proptest::prelude::*;
    use std::string::ToString;

    fn error(text: &str) -> TextError {
        text.parse::<Settings>().unwrap_err()
    }

    fn host() -> impl Strategy<Value = Ipv4Addr> {
        any::<u32>().prop_map(Ipv4Addr::from_bits).prop_filter("of a host", |address| is_of_host(*address))
    }

    #[test]
    fn what_is_not_said_has_its_default() {
        let settings: Settings = "name=a id=1".parse().unwrap();
        assert_eq!(settings.identity, Identity::m_unit("a", 1).unwrap());
        assert_eq!((settings.fleet, settings.network), (Fleet(0), Network::Dhcp));
        assert!(settings.is_sound() && !settings.insecure);
    }

    #[test]
    fn each_mistake_is_reported() {
        assert_eq!(error("name=a id=1 colour=red"), TextError::Word(3));
        assert_eq!(error("name=a id"), TextError::Word(2));
        assert_eq!(error("name=a id=1 id=2"), TextError::Twice(Field::Id));
        assert_eq!(error("id=1"), TextError::Missing(Field::Name));
        assert_eq!(error("name=a"), TextError::Missing(Field::Id));
        assert_eq!(error("name= id=1"), TextError::Value(Field::Name));
        assert_eq!(error("name=a id=-1"), TextError::Value(Field::Id));
        assert_eq!(error("name=a id=1 fleet=4294967296"), TextError::Value(Field::Fleet));
        for manager in ["depot", "depot/x", "/1", "depot/"] {
            assert_eq!(error(&std::format!("name=a id=1 manager={manager}")), TextError::Value(Field::Manager));
        }
        let none = ["239.0.0.7/24", "255.255.255.255/32", "0.0.0.0/24", "127.0.0.1/8"];
        for address in none.into_iter().chain(["10.0.0.1", "10.0.0/24", "10.0.0.1/33", "DHCP"]) {
            assert_eq!(error(&std::format!("name=a id=1 address={address}")), TextError::Value(Field::Address));
        }
        assert_eq!(error("name=a id=1 insecure=no"), TextError::Value(Field::Insecure));
        assert_eq!(error("name=a id=1 gateway=10.0.0.1"), TextError::Value(Field::Gateway));
        let group = error("name=a id=1 address=10.0.0.1/24 gateway=224.0.0.1");
        assert_eq!(group, TextError::Value(Field::Gateway));
        for address in ["depot:1", "224.0.0.1:1"] {
            let text = std::format!("name=a id=1 manager_address={address}");
            assert_eq!(error(&text), TextError::Value(Field::ManagerAddress));
        }
        let text = error("name=a id=1 fleet=x").to_string();
        assert_eq!(text, "fleet is not a number of 32 bits");
    }

    proptest! {
        #[test]
        fn no_text_panics(text in ".{0,80}") {
            let _ = text.parse::<Settings>();
        }

        #[test]
        fn what_is_shown_is_read(
            id: u32, fleet: u32, manager in prop::option::of(("[a-z0-9./_-]{1,32}", any::<u32>())),
            name in "[a-zA-Z0-9_/-]{1,32}", network in prop::option::of((host(), 0_u8..=32, prop::option::of(host()))),
            at in prop::option::of((host(), any::<u16>())), insecure: bool,
        ) {
            let role = if manager.is_some() { Role::SUnit } else { Role::MUnit };
            let settings = Settings {
                identity: Identity::new(&name, id, role).unwrap(),
                manager: manager.map(|(name, id)| Manager::new(&name, id).unwrap()),
                manager_address: at.map(|(address, port)| SocketAddrV4::new(address, port)),
                fleet: Fleet(fleet),
                network: network.map_or(Network::Dhcp, |(address, prefix, gateway)| Network::Static {
                    address, prefix, gateway,
                }),
                wifi: None,
                insecure,
            };
            prop_assert_eq!(settings.to_string().parse(), Ok(settings));
        }
    }
}
