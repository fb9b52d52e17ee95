//! The bytes of an input, read as the steps of a test. At their end everything is 0.

/// What is left of an input.
#[derive(Clone, Copy, Debug)]
pub struct Script<'d>(&'d [u8]);

impl<'d> Script<'d> {
    /// Of these bytes.
    pub const fn new(bytes: &'d [u8]) -> Self {
        Self(bytes)
    }

    /// Whether nothing is left.
    pub const fn is_over(&self) -> bool {
        self.0.is_empty()
    }

    /// The next byte.
    pub fn byte(&mut self) -> u8 {
        let Some((&first, rest)) = self.0.split_first() else { return 0 };
        self.0 = rest;
        first
    }

    /// A number below `end`.
    pub fn below(&mut self, end: u8) -> u8 {
        self.byte() % end
    }

    /// Yes or no.
    pub fn flag(&mut self) -> bool {
        self.byte() & 1 != 0
    }

    /// Mostly a small number, so that it means something to the receiver; any number behind a byte of 0xF0 or more.
    pub fn number(&mut self) -> u64 {
        match self.byte() {
            small @ ..0xE0 => small.into(),
            middle @ ..0xF0 => u64::from(middle - 0xE0) << 8 | u64::from(self.byte()),
            _ => u64::from_le_bytes(std::array::from_fn(|_| self.byte())),
        }
    }

    /// Up to 255 bytes, as the first one says.
    pub fn bytes(&mut self) -> &'d [u8] {
        let length = usize::from(self.byte()).min(self.0.len());
        let (bytes, rest) = self.0.split_at(length);
        self.0 = rest;
        bytes
    }

    /// All that is left.
    pub const fn rest(self) -> &'d [u8] {
        self.0
    }
}

/// Pieces where they are meant, and other characters as they are.
pub fn text(mut script: Script<'_>, pieces: &[&str]) -> String {
    let mut text = String::new();
    while !script.is_over() {
        let byte = script.byte();
        match pieces.get(usize::from(byte.wrapping_sub(128))) {
            Some(piece) => text.push_str(piece),
            None => text.push(char::from(byte)),
        }
    }
    text
}
