//! What a board was provisioned with: its identity, and the keys that prove it. Without keys a board joins no manager,
//! unless its settings opt in to plain mode explicitly.

use cara_embassy::Security;
#[cfg(feature = "secure")]
use cara_secure::random::{BootCounter, Random};
use cara_settings::Settings;
#[cfg(feature = "secure")]
use cara_settings::boots::ClaimStore;
#[cfg(feature = "secure")]
use cara_settings::keys::KeysError;
use cara_settings::page::{self, PageError};

#[cfg(feature = "secure")]
use crate::claims;
use crate::info;

/// The keys of a vehicle, with as many managers as it can have.
#[cfg(feature = "secure")]
pub type Keys = cara_settings::keys::Keys<{ if cfg!(feature = "hand-over") { 2 } else { 1 } }>;

/// What a vehicle was provisioned with.
pub struct Provision {
    /// Its settings, with its identity.
    pub settings: Settings,
    /// How it proves its identity.
    pub proof: Proof,
}

/// How a board proves its identity.
// Only one exists, while a board starts; boxing its keys would need an allocator.
#[allow(clippy::large_enum_variant)]
pub enum Proof {
    /// Not at all: its settings opt in to plain mode.
    Insecure,
    /// With its keys.
    #[cfg(feature = "secure")]
    Keys(Keys),
}

impl Provision {
    /// Reads the two pages of a board; where something is missing the log tells what.
    pub fn read(first: &[u8], second: &[u8]) -> Option<Self> {
        let settings = provisioned(page::newest(first, second))?;
        if [first, second].into_iter().any(|copy| page::decode(copy).is_err_and(|error| error != PageError::Absent)) {
            info!(
                "a copy of the settings is damaged, and the other one counts, which may be older: write them again with cara provision"
            );
        }
        #[cfg(feature = "secure")]
        let found = Self::of(settings, || cara_settings::keys::newest(first, second).map(|(_, keys)| keys));
        #[cfg(not(feature = "secure"))]
        let found = Self::of(settings);
        found
    }

    /// With the settings of a vehicle, and the keys where it needs any.
    #[cfg(feature = "secure")]
    pub fn of(settings: Settings, keys: impl FnOnce() -> Result<Keys, KeysError>) -> Option<Self> {
        if settings.insecure {
            return Some(Self { settings, proof: Proof::Insecure });
        }
        match keys() {
            Ok(keys) => return Some(Self { settings, proof: Proof::Keys(keys) }),
            Err(KeysError::Full) => info!("the keys are those of more managers than this image has room for"),
            Err(KeysError::Absent | KeysError::Page(_)) => {
                info!("there are no keys, and this board joins no manager without: give cara provision its --keys FILE")
            }
            Err(KeysError::Unsound | KeysError::Text(_)) => {
                info!("the keys are damaged, and this board joins no manager: write them again with cara provision")
            }
        }
        None
    }

    /// With the settings of a vehicle; this image has no cipher.
    #[cfg(not(feature = "secure"))]
    pub fn of(settings: Settings) -> Option<Self> {
        if settings.insecure {
            return Some(Self { settings, proof: Proof::Insecure });
        }
        info!("this image is for plain mode alone, and the settings do not ask for it: give cara provision --insecure");
        None
    }
}

#[cfg(feature = "secure")]
impl Proof {
    /// Begins a life of the board: moves the count of its starts, before the network starts, and draws from it and from what
    /// noise the hardware has. `None` when the count cannot be kept, which the log tells: the board could repeat itself.
    /// With keys, the vehicle stores the claim that it obeys beside the count.
    pub fn begin<C: BootCounter + ClaimStore>(self, boots: &'static mut C, noise: [u32; 2]) -> Option<Security> {
        match self {
            Self::Insecure => Some(Security::insecure(seed(noise))),
            Self::Keys(keys) => match Random::start(keys.secret().clone(), boots, &noise) {
                Ok(random) => {
                    claims::lend(boots);
                    Some(Security::keys(lend(keys), random))
                }
                Err(_) => {
                    crate::error!(
                        "the count of starts cannot be kept, and this board joins no manager: its flash is worn out"
                    );
                    None
                }
            },
        }
    }

    /// With random numbers that are the same in each boot, for tests only: any holder of these numbers can compute the
    /// keys of a link with another unit that draws as badly.
    pub fn begin_constant(self) -> Security {
        crate::error!("CONSTANT RANDOM NUMBERS: this image is for tests only, and keeps nothing secret");
        match self {
            Self::Insecure => Security::insecure(0),
            Self::Keys(keys) => Security::keys(lend(keys), Random::constant()),
        }
    }
}

#[cfg(not(feature = "secure"))]
impl Proof {
    /// Begins a life of the board.
    pub fn begin(self, noise: [u32; 2]) -> Security {
        Security::insecure(seed(noise))
    }
}

/// Noise as [`Proof::begin`] takes it.
pub const fn halves(noise: u64) -> [u32; 2] {
    [(noise >> 32) as u32, noise as u32]
}

fn seed([high, low]: [u32; 2]) -> u64 {
    u64::from(high) << 32 | u64::from(low)
}

/// A board has one unit, and its keys are there for good.
#[cfg(feature = "secure")]
fn lend(keys: Keys) -> &'static Keys {
    static KEYS: static_cell::StaticCell<Keys> = static_cell::StaticCell::new();
    KEYS.init(keys)
}

/// The settings of a vehicle; where there are none the log tells why.
pub fn provisioned(read: Result<Settings, PageError>) -> Option<Settings> {
    match read {
        Ok(settings) if settings.manager.is_some() => return Some(settings),
        Ok(_) => info!("a vehicle belongs to a manager, and the settings name none: give cara provision a --manager"),
        Err(PageError::Absent) => info!("there are no settings: write them with cara provision"),
        Err(PageError::Layout(_layout)) => {
            info!("settings of layout {}: write them again, or update the image", _layout)
        }
        Err(PageError::Damaged) => {
            info!("the settings are damaged: write them again with cara provision")
        }
        Err(PageError::Unsound) => {
            info!(
                "the settings are of no unit, or of an address that no host can have: write them again with cara provision"
            )
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reported(text: &str) -> Settings {
        text.parse().unwrap()
    }

    #[test]
    fn a_vehicle_without_a_manager_is_not_provisioned() {
        assert!(provisioned(Ok(reported("name=agv id=1 manager=depot/1"))).is_some());
        assert!(provisioned(Ok(reported("name=agv id=1"))).is_none());
        assert!(provisioned(Err(PageError::Damaged)).is_none());
    }

    #[cfg(feature = "secure")]
    #[test]
    fn a_board_without_keys_joins_nobody_unless_it_is_told_so_in_words() {
        let absent = || Err(KeysError::Absent);
        assert!(Provision::of(reported("name=agv id=1 manager=depot/1"), absent).is_none());
        let insecure = Provision::of(reported("name=agv id=1 manager=depot/1 insecure=yes"), absent);
        assert!(matches!(insecure, Some(Provision { proof: Proof::Insecure, .. })));
    }

    #[cfg(feature = "secure")]
    #[test]
    fn a_board_that_cannot_count_its_starts_joins_nobody() {
        use cara_core::distribution::claim::StoredClaim;
        use cara_secure::keys::{DeviceSecret, DiscoveryKey};
        use std::boxed::Box;

        struct Worn;

        impl BootCounter for Worn {
            type Error = ();

            fn advance(&mut self) -> Result<u64, ()> {
                Err(())
            }
        }

        impl ClaimStore for Worn {
            fn stored(&mut self) -> Option<StoredClaim> {
                None
            }

            fn store(&mut self, _: &StoredClaim) -> bool {
                false
            }
        }

        let worn = || Box::leak(Box::new(Worn));
        let keys = Keys::new(DeviceSecret::new([1; 32]), 1, DiscoveryKey::new([2; 32]));
        assert!(Proof::Keys(keys).begin(worn(), [0; 2]).is_none());
        assert!(Proof::Insecure.begin(worn(), [0; 2]).is_some());
    }
}
