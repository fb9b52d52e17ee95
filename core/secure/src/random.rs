//! Random numbers for boards, whose noise sources may be poor or constant.
//!
//! A draw is a keyed hash over everything that may differ: the board's secret as the key, the count of its boots, the count of
//! draws in this boot, noise of the hardware, and what peers have drawn. The secret makes draws unpredictable, the two counters
//! make them unique, each independently:
//!
//! - with constant noise no two draws are equal, as long as the boot counter advances;
//! - if the boot counter stands still, too, what peers have drawn distinguishes two boots, for draws after [`Random::stir`];
//! - if the secret is known to others, only the noise is left.
//!
//! Therefore a [`BootCounter`] is advanced, and stored where it survives a loss of power, before the network starts.

use blake2::digest::Mac;
use zeroize::Zeroize;

use crate::keys::{DeviceSecret, KEY_BYTES, keyed};

/// Bytes of one draw.
pub const DRAW_BYTES: usize = 32;

/// The count of the board's boots, stored where it survives a loss of power.
pub trait BootCounter {
    /// Why the counter could not be stored.
    type Error;

    /// Advances the counter, and returns the new value once it is stored: no value is returned twice. After an error the board
    /// must not start its network, since it could repeat earlier draws.
    fn advance(&mut self) -> Result<u64, Self::Error>;
}

/// A board's random numbers. One for each boot; it cannot be cloned.
pub struct Random {
    secret: DeviceSecret,
    boot: u64,
    drawn: u64,
    /// All noise so far, and what peers have drawn.
    pool: [u8; DRAW_BYTES],
}

impl Random {
    /// Starts a boot: advances the counter, and mixes in the available noise.
    pub fn start<C: BootCounter>(secret: DeviceSecret, counter: &mut C, noise: &[u32]) -> Result<Self, C::Error> {
        let mut random = Self { secret, boot: counter.advance()?, drawn: 0, pool: [0; DRAW_BYTES] };
        random.stir_words(noise);
        Ok(random)
    }

    /// A generator for tests that must draw the same in each boot: a known secret, and boot 0.
    pub const fn constant() -> Self {
        Self { secret: DeviceSecret::new([0; KEY_BYTES]), boot: 0, drawn: 0, pool: [0; DRAW_BYTES] }
    }

    /// Mixes noise of the hardware into all later draws.
    pub fn stir_words(&mut self, noise: &[u32]) {
        let mut mac = keyed(self.secret.expose());
        mac.update(b"stir");
        mac.update(&self.pool);
        noise.iter().for_each(|word| mac.update(&word.to_le_bytes()));
        self.pool = mac.finalize().into_bytes().into();
    }

    /// Mixes what a peer has drawn, such as the nonce of its hello, into all later draws.
    pub fn stir(&mut self, nonce: &[u8]) {
        let mut mac = keyed(self.secret.expose());
        mac.update(b"peer");
        mac.update(&self.pool);
        mac.update(nonce);
        self.pool = mac.finalize().into_bytes().into();
    }

    /// Draws 32 bytes.
    pub fn draw(&mut self) -> [u8; DRAW_BYTES] {
        let mut mac = keyed(self.secret.expose());
        mac.update(b"draw");
        mac.update(&self.boot.to_le_bytes());
        mac.update(&self.drawn.to_le_bytes());
        mac.update(&self.pool);
        // Wraps after half a million years at a million draws a second.
        self.drawn = self.drawn.wrapping_add(1);
        mac.finalize().into_bytes().into()
    }

    /// Fills `bytes`.
    pub fn fill(&mut self, bytes: &mut [u8]) {
        for piece in bytes.chunks_mut(DRAW_BYTES) {
            let mut drawn = self.draw();
            piece.iter_mut().zip(drawn).for_each(|(to, from)| *to = from);
            drawn.zeroize();
        }
    }
}

impl Drop for Random {
    fn drop(&mut self) {
        self.pool.zeroize();
    }
}

/// Reveals nothing of its draws.
impl core::fmt::Debug for Random {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Random(…)")
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing)]
    use super::*;
    use crate::channel::TAG_BYTES;
    use crate::handshake::{Initiator, answer};
    use crate::keys::PairKey;
    use crate::suite::Suite;
    use cara_core::host::secure::Seal;
    use std::collections::HashSet;
    use std::vec::Vec;

    /// Noise that never changes.
    const NOISE: [u32; 4] = [0; 4];
    const BOOTS: u64 = 10_000;

    /// A counter that moves, or does not.
    struct Kept {
        value: u64,
        step: u64,
    }

    impl BootCounter for Kept {
        type Error = &'static str;

        fn advance(&mut self) -> Result<u64, Self::Error> {
            self.value += self.step;
            if self.value < u64::MAX / 2 { Ok(self.value) } else { Err("the page is worn out") }
        }
    }

    fn secret() -> DeviceSecret {
        DeviceSecret::new([9; KEY_BYTES])
    }

    fn life(counter: &mut Kept) -> Random {
        Random::start(secret(), counter, &NOISE).unwrap()
    }

    /// What a board draws in a life: for two handshakes and their datagrams.
    fn drawn(random: &mut Random) -> [[u8; DRAW_BYTES]; 4] {
        core::array::from_fn(|_| random.draw())
    }

    #[test]
    fn with_constant_noise_nothing_is_drawn_twice_while_the_counter_moves() {
        let mut counter = Kept { value: 0, step: 1 };
        let all: HashSet<_> = (0..BOOTS).flat_map(|_| drawn(&mut life(&mut counter))).collect();
        assert_eq!(all.len() as u64, BOOTS * 4);
    }

    #[test]
    fn where_the_counter_stands_still_the_peer_still_tells_lives_apart() {
        let mut counter = Kept { value: 5, step: 0 };
        let alike: HashSet<_> = (0..BOOTS).flat_map(|_| drawn(&mut life(&mut counter))).collect();
        assert_eq!(alike.len(), 4, "this is what the counter is for");
        let distinguished = (0..BOOTS).flat_map(|peer| {
            let mut random = life(&mut counter);
            random.stir(&peer.to_le_bytes());
            drawn(&mut random)
        });
        assert_eq!(distinguished.collect::<HashSet<_>>().len() as u64, BOOTS * 4);
    }

    /// The keys of a link are new if one end's draw is: whatever is sealed under the same number differs.
    fn first_frame(board: &mut Random, manager: [u8; 32]) -> Vec<u8> {
        let (pair, prologue) = (PairKey::new([3; KEY_BYTES]), [4; 32]);
        let (initiator, message) = Initiator::begin(Suite::ChaChaPoly, &pair, &prologue, &board.draw()).unwrap();
        let (_, message) = answer(Suite::ChaChaPoly, &pair, &prologue, &manager, &message).unwrap();
        let mut channel = initiator.finish(&message).unwrap().channel;
        let mut frame = std::vec![0; 64 + TAG_BYTES];
        channel.seal(&mut frame).unwrap();
        frame
    }

    #[test]
    fn no_key_and_number_repeat_with_a_manager_that_draws_the_same_too() {
        const LIVES: usize = 20;
        let mut counter = Kept { value: 0, step: 1 };
        let moved: HashSet<_> = (0..LIVES).map(|_| first_frame(&mut life(&mut counter), [8; 32])).collect();
        assert_eq!(moved.len(), LIVES);
        // With nothing that moves, the same key seals the same number again.
        let mut still = Kept { value: 0, step: 0 };
        let repeated: HashSet<_> = (0..LIVES).map(|_| first_frame(&mut life(&mut still), [8; 32])).collect();
        assert_eq!(repeated.len(), 1);
        // One end that draws well is enough.
        let other = (0..LIVES as u8).map(|drawn| first_frame(&mut life(&mut still), [drawn + 1; 32]));
        assert_eq!(other.collect::<HashSet<_>>().len(), LIVES);
    }

    #[test]
    fn whatever_differs_changes_what_is_drawn() {
        let counter = || Kept { value: 0, step: 1 };
        let of = |secret, noise: &[u32]| Random::start(secret, &mut counter(), noise).unwrap().draw();
        let mut fed = life(&mut counter());
        fed.stir(&[0; 16]);
        let mut words = life(&mut counter());
        words.stir_words(&[0; 4]);
        let draws = [
            of(secret(), &NOISE),
            of(DeviceSecret::new([8; KEY_BYTES]), &NOISE),
            of(secret(), &[0, 0, 0, 1]),
            of(secret(), &[]),
            fed.draw(),
            words.draw(),
        ];
        assert_eq!(HashSet::from(draws).len(), draws.len());
    }

    #[test]
    fn a_counter_that_is_not_kept_starts_nothing() {
        let mut worn = Kept { value: u64::MAX / 2, step: 1 };
        assert_eq!(Random::start(secret(), &mut worn, &NOISE).map(drop), Err("the page is worn out"));
    }

    #[test]
    fn pieces_of_any_length_are_filled() {
        for length in [0, 1, 31, 32, 33, 100] {
            let (mut one, mut other) = (std::vec![0; length], std::vec![0; length]);
            Random::constant().fill(&mut one);
            Random::constant().fill(&mut other);
            assert_eq!(one, other);
            assert!(length < 16 || one.iter().any(|byte| *byte != 0));
        }
        let mut random = Random::constant();
        assert_ne!(random.draw(), random.draw());
    }

    /// The generator is a keyed hash as it stands in the design; computed with another implementation, Python's
    /// `hashlib.blake2s(b"draw" + bytes(48), key=bytes(32))`.
    #[test]
    fn the_generator_stays() {
        let shown = Random::constant()
            .draw()
            .iter()
            .fold(std::string::String::new(), |text, byte| text + &std::format!("{byte:02x}"));
        assert_eq!(shown, "b487b497a398ba081f0d87b663e6e87b038296d939b40b0b0b1796877dc1e47d");
    }

    #[test]
    fn nothing_of_it_is_shown() {
        assert_eq!(std::format!("{:?}", Random::constant()), "Random(…)");
    }
}
