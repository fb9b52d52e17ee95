//! Attributes of a function: priority, lease, actuator and flags.

use proc_macro2::TokenStream;
use quote::{format_ident, quote};
use syn::parse::{Parse, ParseStream};
use syn::spanned::Spanned;
use syn::{Attribute, Error, Ident, Lit, LitInt, Meta, Result, Token};

use crate::attributes::{extract, extract_if, is_one_of, set};

/// The attributes of a function.
#[derive(Default)]
pub(crate) struct Attributes {
    pub(crate) priority: Option<Ident>,
    pub(crate) lease: Option<LitInt>,
    pub(crate) actuator: Option<Ident>,
    /// The attributes without a value. The core knows which exist: each sets the field with its name.
    flags: Vec<Ident>,
}

/// The classes, as the attribute and the enum `Priority` name them.
const PRIORITIES: [(&str, &str); 4] =
    [("emergency", "Emergency"), ("high", "High"), ("normal", "Normal"), ("low", "Low")];
/// Attributes of Rust itself, or with a value, which are no flags.
const NO_FLAGS: [&str; 8] = ["cold", "deprecated", "help", "inline", "must_use", "name", "returns", "track_caller"];
/// A shorter lease cannot be renewed in time.
const SHORTEST_LEASE: u64 = 20;

impl Attributes {
    /// Takes these attributes out of a list.
    pub(crate) fn take(attributes: &mut Vec<Attribute>) -> Result<Self> {
        let mut found = Self::default();
        for attribute in extract(attributes, &["priority", "lease", "actuator"]) {
            match attribute.path().get_ident().map(ToString::to_string).unwrap_or_default().as_str() {
                "priority" => set(&mut found.priority, read_priority(&attribute)?, &attribute)?,
                "lease" => set(&mut found.lease, read_lease(&attribute)?, &attribute)?,
                _ => {
                    let wrong = |_| Error::new(attribute.span(), "write #[actuator(drive)]: the name of what it moves");
                    set(&mut found.actuator, attribute.parse_args().map_err(wrong)?, &attribute)?;
                }
            }
        }
        let is_flag = |attribute: &Attribute| matches!(&attribute.meta, Meta::Path(path) if path.get_ident().is_some());
        for attribute in extract_if(attributes, |attribute| is_flag(attribute) && !is_one_of(attribute, &NO_FLAGS)) {
            let flag = attribute.path().get_ident().cloned();
            if flag.as_ref().is_some_and(|flag| found.flags.contains(flag)) {
                return Err(Error::new_spanned(attribute, "this attribute is there twice"));
            }
            found.flags.extend(flag);
        }
        Ok(found)
    }

    /// Whether it has this flag.
    pub(crate) fn has(&self, flag: &str) -> bool {
        self.flags.iter().any(|found| found == flag)
    }

    /// An expression of the core's `Attributes`.
    pub(crate) fn expression(&self, root: &TokenStream) -> TokenStream {
        let Self { priority, lease, flags, .. } = self;
        let parts = quote!(#root::typed::parts);
        let word = priority.as_ref().map_or("normal".to_owned(), ToString::to_string);
        let class = PRIORITIES.iter().find(|(name, _)| *name == word).map_or("Normal", |(_, class)| class);
        let class = format_ident!("{class}");
        let lease = match lease {
            Some(ms) => quote!(::core::option::Option::Some(#parts::Duration::from_millis(#ms))),
            None => quote!(::core::option::Option::None),
        };
        quote!(#parts::Attributes {
            priority: #parts::Priority::#class,
            lease: #lease,
            #(#flags: true,)*
            ..#parts::Attributes::NORMAL
        })
    }
}

fn read_priority(attribute: &Attribute) -> Result<Ident> {
    let wrong = "a priority is `emergency`, `high`, `normal` or `low`: #[priority(high)]";
    let word: Ident = attribute.parse_args().map_err(|_| Error::new(attribute.span(), wrong))?;
    if PRIORITIES.iter().any(|(name, _)| word == name) { Ok(word) } else { Err(Error::new(word.span(), wrong)) }
}

fn read_lease(attribute: &Attribute) -> Result<LitInt> {
    let wrong = || Error::new(attribute.span(), "write #[lease(ms = 400)]: milliseconds after the caller's last sign");
    let pair: Pair = attribute.parse_args().map_err(|_| wrong())?;
    let Lit::Int(ms) = pair.value else { return Err(wrong()) };
    if pair.name != "ms" {
        return Err(wrong());
    }
    match ms.base10_parse::<u32>()? {
        length if u64::from(length) < SHORTEST_LEASE => {
            Err(Error::new(ms.span(), "a lease of less than 20 ms cannot be kept: renewals are 5 ms apart"))
        }
        _ => Ok(ms),
    }
}

/// `name = literal`.
struct Pair {
    name: Ident,
    value: Lit,
}

impl Parse for Pair {
    fn parse(input: ParseStream<'_>) -> Result<Self> {
        let name = input.parse()?;
        input.parse::<Token![=]>()?;
        Ok(Self { name, value: input.parse()? })
    }
}
