//! The Rust types for one element of a variable, and its layout in memory: little-endian, of fixed width.

use super::value::Type;
use crate::bytes::copy;

mod sealed {
    pub trait Sealed {}
}

/// A Rust type for one element of a variable: the integers, `f32`, `f64` and `bool`.
pub trait Element: Copy + Default + sealed::Sealed {
    /// The type of the variable.
    const KIND: Type;
    /// Reads an element; `None` if it is out of this type's range.
    #[doc(hidden)]
    fn load(place: &[u8]) -> Option<Self>;
    /// Writes an element that fits.
    #[doc(hidden)]
    fn store(&self, place: &mut [u8]);
    /// Whether the element can be stored.
    #[doc(hidden)]
    fn fits(&self) -> bool {
        true
    }
    /// The elements as bytes, if they are bytes.
    #[doc(hidden)]
    fn as_bytes(_: &[Self]) -> Option<&[u8]> {
        None
    }
    /// The elements as bytes, if they are bytes.
    #[doc(hidden)]
    fn as_bytes_mut(_: &mut [Self]) -> Option<&mut [u8]> {
        None
    }
}

macro_rules! integer {
    ($($integer:ty { $($more:item)* })*) => {$(
        impl sealed::Sealed for $integer {}
        impl Element for $integer {
            const KIND: Type = Type::Int;
            fn load(place: &[u8]) -> Option<Self> {
                place.try_into().ok().and_then(|word| Self::try_from(i64::from_le_bytes(word)).ok())
            }
            fn store(&self, place: &mut [u8]) {
                copy(&i64::try_from(*self).unwrap_or_default().to_le_bytes(), place);
            }
            fn fits(&self) -> bool {
                i64::try_from(*self).is_ok()
            }
            $($more)*
        }
    )*};
}

integer! {
    i8 {}
    i16 {}
    i32 {}
    i64 {}
    isize {}
    u16 {}
    u32 {}
    u64 {}
    usize {}
    u8 {
        fn as_bytes(elements: &[Self]) -> Option<&[u8]> {
            Some(elements)
        }
        fn as_bytes_mut(elements: &mut [Self]) -> Option<&mut [u8]> {
            Some(elements)
        }
    }
}

impl sealed::Sealed for f64 {}
impl Element for f64 {
    const KIND: Type = Type::Float;
    fn load(place: &[u8]) -> Option<Self> {
        place.try_into().ok().map(Self::from_le_bytes)
    }
    fn store(&self, place: &mut [u8]) {
        copy(&self.to_le_bytes(), place);
    }
}

impl sealed::Sealed for f32 {}
impl Element for f32 {
    const KIND: Type = Type::Float;
    /// Rounds to nearest. A finite number that would become infinite is out of range.
    fn load(place: &[u8]) -> Option<Self> {
        let wide = f64::load(place)?;
        let narrow = wide as f32;
        (narrow.is_finite() || !wide.is_finite()).then_some(narrow)
    }
    fn store(&self, place: &mut [u8]) {
        f64::from(*self).store(place);
    }
}

impl sealed::Sealed for bool {}
impl Element for bool {
    const KIND: Type = Type::Bool;
    fn load(place: &[u8]) -> Option<Self> {
        place.first().map(|&byte| byte != 0)
    }
    fn store(&self, place: &mut [u8]) {
        copy(&[u8::from(*self)], place);
    }
}
