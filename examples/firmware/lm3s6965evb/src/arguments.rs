//! What this board is told: an emulator's board has no flash that outlives it, so its settings come as arguments of the
//! command line (QEMU: `-semihosting-config …,arg=agv,arg="name=agv-17 id=17 manager=depot/1 address=dhcp"`), in the
//! text form of [`Settings`].
//!
//! `seed=N` among them replaces the random seed, for tests in which each life draws the same numbers.

use cara_settings::{Settings, TextError};
use heapless::String;

/// Most bytes of all arguments.
const BYTES: usize = 256;

/// What the command line told.
pub struct Told {
    /// The settings.
    pub settings: Settings,
    /// The random seed, if it is to be a certain one.
    pub seed: Option<u64>,
}

/// Why the board does not know who it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArgumentError {
    /// The emulator gives none, or more than fit.
    None,
    /// They are not settings.
    Settings(TextError),
}

/// Reads the arguments.
pub fn read() -> Result<Told, ArgumentError> {
    let arguments = semihosting::experimental::env::args::<BYTES>().map_err(|_| ArgumentError::None)?;
    let mut text: String<BYTES> = String::new();
    let mut seed = None;
    // The first one is the program's name.
    for argument in (&arguments).into_iter().skip(1) {
        for word in argument.unwrap_or_default().split_whitespace() {
            match word.strip_prefix("seed=").map(str::parse) {
                Some(Ok(number)) => seed = Some(number),
                Some(Err(_)) => return Err(ArgumentError::None),
                None => text.push_str(word).and_then(|()| text.push(' ')).map_err(|_| ArgumentError::None)?,
            }
        }
    }
    let settings = text.parse().map_err(ArgumentError::Settings)?;
    Ok(Told { settings, seed })
}

/// A seed from the host's clock: an emulated board has no source of noise.
pub fn seed() -> u64 {
    let centiseconds = semihosting::sys::arm_compat::sys_clock().unwrap_or(0) as u64;
    let seconds = semihosting::sys::arm_compat::sys_time().unwrap_or(0) as u64;
    seconds << 32 | centiseconds << 16 | embassy_time::Instant::now().as_micros() & 0xFFFF
}
