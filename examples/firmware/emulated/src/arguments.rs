//! What an emulated board is told: it has no flash that outlives it, so its settings come as arguments of the
//! command line (QEMU: `-semihosting-config …,arg=agv,arg="name=agv-17 id=17 manager=depot/1 address=dhcp"`), in the
//! text form of [`Settings`].
//!
//! Words that only such a board knows:
//!
//! - `file=PATH`: more words stand in a file of the host, as `cara provision BOARD --output PATH` writes it. Keys
//!   do, because a list of the host's processes shows arguments;
//! - `boots=PATH`: the file of the host that stands for the two pages of flash of the board's boot counter and its
//!   term;
//! - `at=X,Y`, of the image with the feature `warehouse`: the cell in which its vehicle stands;
//! - `seed=N` replaces the hardware's noise, for tests in which each boot has the same.

#[cfg(feature = "warehouse")]
use cara_apps::warehouse::Cell;
use cara_settings::{Settings, TextError};
#[cfg(not(feature = "secure"))]
use cara_vehicle::provision::{Provision, halves};
use heapless::{String, Vec};
use semihosting::fs::File;
use semihosting::io::Read;

/// Most bytes of all arguments.
const BYTES: usize = 256;
/// Most bytes of all words: the keys of a vehicle in two generations with the longest names, and its settings.
const WORDS: usize = 1024;

/// What the command line told.
pub struct Given {
    /// The settings.
    pub settings: Settings,
    /// Where a vehicle of the warehouse stands.
    #[cfg(feature = "warehouse")]
    pub at: Option<Cell>,
    /// What makes random numbers differ.
    pub noise: u64,
    #[cfg(feature = "secure")]
    secrets: secured::Secrets,
}

/// Why the board has no settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArgumentError {
    /// The emulator gives none, or more than fit.
    None,
    /// The file that they name cannot be read.
    File,
    /// They are not settings.
    Settings(TextError),
}

impl ArgumentError {
    /// What the log says of it.
    pub const fn text(self) -> &'static str {
        match self {
            Self::None => "there are no arguments, or more than this board has room for",
            Self::File => "the file that the arguments name cannot be read",
            Self::Settings(_) => "the arguments are no settings",
        }
    }
}

/// The words of the arguments, and those that are not of the settings.
#[derive(Default)]
struct Words {
    text: Vec<u8, WORDS>,
    seed: Option<u64>,
    #[cfg(feature = "warehouse")]
    at: Option<Cell>,
    file: Path,
    boots: Path,
}

/// A file of the host.
pub(crate) type Path = String<128>;

impl Words {
    fn add(&mut self, word: &str) -> Result<(), ()> {
        match word.split_once('=') {
            Some(("seed", number)) => self.seed = Some(number.parse().map_err(drop)?),
            #[cfg(feature = "warehouse")]
            Some(("at", cell)) => self.at = Some(cell.parse()?),
            Some(("file", path)) => self.file = String::try_from(path).map_err(drop)?,
            Some(("boots", path)) => self.boots = String::try_from(path).map_err(drop)?,
            _ => [word.as_bytes(), b" "].iter().try_for_each(|part| self.text.extend_from_slice(part)).map_err(drop)?,
        }
        Ok(())
    }

    /// The words of the settings.
    fn text(&self) -> &str {
        core::str::from_utf8(&self.text).unwrap_or_default()
    }
}

/// Reads the arguments, and the file that they name.
pub fn read() -> Result<Given, ArgumentError> {
    let mut words = Words::default();
    add_arguments(&mut words).map_err(|()| ArgumentError::None)?;
    if !words.file.is_empty() {
        add_file(&mut words).map_err(|()| ArgumentError::File)?;
    }
    let settings = words.text().parse().map_err(ArgumentError::Settings)?;
    let noise = words.seed.unwrap_or_else(clock);
    Ok(Given {
        settings,
        #[cfg(feature = "warehouse")]
        at: words.at,
        noise,
        #[cfg(feature = "secure")]
        secrets: secured::Secrets::of(&words),
    })
}

#[inline(never)]
fn add_arguments(words: &mut Words) -> Result<(), ()> {
    let arguments = semihosting::experimental::env::args::<BYTES>().map_err(drop)?;
    // The first one is the program's name.
    let arguments = (&arguments).into_iter().skip(1).map(Result::unwrap_or_default);
    arguments.flat_map(str::split_whitespace).try_for_each(|word| words.add(word))
}

fn add_file(words: &mut Words) -> Result<(), ()> {
    words.file.push('\0').map_err(drop)?;
    let path = core::ffi::CStr::from_bytes_with_nul(words.file.as_bytes()).map_err(drop)?;
    let mut file = File::open(path).map_err(drop)?;
    let mut length = words.text.len();
    words.text.resize_default(WORDS).map_err(drop)?;
    loop {
        match file.read(words.text.get_mut(length..).unwrap_or_default()).map_err(drop)? {
            0 => break,
            more => length += more,
        }
    }
    words.text.truncate(length);
    Ok(())
}

/// From the host's clock: an emulated board has no source of noise.
fn clock() -> u64 {
    let centiseconds = semihosting::sys::arm_compat::sys_clock().unwrap_or(0) as u64;
    let seconds = semihosting::sys::arm_compat::sys_time().unwrap_or(0) as u64;
    seconds << 32 | centiseconds << 16 | embassy_time::Instant::now().as_micros() & 0xFFFF
}

#[cfg(feature = "secure")]
mod secured {
    use cara_embassy::Security;
    use cara_settings::Settings;
    use cara_settings::keys::{KeysError, of_text};
    use cara_vehicle::provision::{Keys, Provision, halves};

    use static_cell::StaticCell;

    use super::{Given, Path, Words};
    use crate::boots;

    /// The keys, and the file of the host for the count of starts.
    pub(super) struct Secrets {
        keys: Result<Keys, KeysError>,
        boots: Path,
    }

    impl Secrets {
        #[inline(never)]
        pub(super) fn of(words: &Words) -> Self {
            let keys = of_text(words.text()).and_then(|keys| keys.ok_or(KeysError::Absent));
            Self { keys, boots: words.boots.clone() }
        }
    }

    impl Given {
        /// The settings, the proof of identity, and the noise; raises the boot counter. `None` without keys, which is
        /// logged.
        #[inline(never)]
        pub fn security(self) -> Option<(Settings, Security, u64)> {
            static BOOTS: StaticCell<boots::File> = StaticCell::new();
            let Self { settings, noise, secrets: Secrets { keys, boots }, .. } = self;
            let Provision { settings, proof } = Provision::of(settings, || keys)?;
            let security = if cfg!(feature = "constant-random") {
                proof.begin_constant()
            } else {
                proof.begin(BOOTS.init(boots::File::open(&boots)), halves(noise))?
            };
            Some((settings, security, noise))
        }
    }
}

#[cfg(not(feature = "secure"))]
impl Given {
    /// The settings, plain mode if the settings opt in to it, and the noise.
    pub fn security(self) -> Option<(Settings, cara_embassy::Security, u64)> {
        let Provision { settings, proof } = Provision::of(self.settings)?;
        Some((settings, proof.begin(halves(self.noise)), self.noise))
    }
}
