//! Attributes of fields, arguments and functions.

use syn::punctuated::Punctuated;
use syn::spanned::Spanned;
use syn::{Attribute, Error, Expr, ExprLit, Ident, Lit, LitInt, LitStr, Meta, Result, Token};

/// Most bytes of text or bytes, or elements of a list, that can be declared.
const LARGEST: u64 = u32::MAX as u64;

/// `#[size(200)]` and `#[name = "…"]` of a variable.
#[derive(Default)]
pub(crate) struct OfVariable {
    /// As `#[size(50, 32)]` has them: of a list, then of its elements.
    pub(crate) size: Vec<LitInt>,
    pub(crate) name: Option<String>,
}

impl OfVariable {
    /// Takes its attributes away from others.
    pub(crate) fn take(attributes: &mut Vec<Attribute>) -> Result<Self> {
        let mut found = Self::default();
        let mut size = None;
        for attribute in extract(attributes, &["size", "name"]) {
            if attribute.path().is_ident("size") {
                set(&mut size, sizes(&attribute)?, &attribute)?;
            } else {
                set(&mut found.name, text(&attribute)?.value(), &attribute)?;
            }
        }
        found.size = size.unwrap_or_default();
        Ok(found)
    }

    /// The name, where it is not the Rust name.
    pub(crate) fn name_or(&mut self, ident: &Ident) -> String {
        self.name.take().unwrap_or_else(|| plain(ident))
    }
}

/// An identifier without `r#`.
pub(crate) fn plain(ident: &Ident) -> String {
    let text = ident.to_string();
    text.strip_prefix("r#").map_or(text.clone(), str::to_owned)
}

/// Takes the attributes of these names out.
pub(crate) fn extract(attributes: &mut Vec<Attribute>, names: &[&str]) -> Vec<Attribute> {
    let (taken, kept) = std::mem::take(attributes)
        .into_iter()
        .partition(|attribute| names.iter().any(|name| attribute.path().is_ident(name)));
    *attributes = kept;
    taken
}

/// Sets what may be said once.
pub(crate) fn set<T>(place: &mut Option<T>, value: T, attribute: &Attribute) -> Result<()> {
    match place.replace(value) {
        None => Ok(()),
        Some(_) => Err(Error::new_spanned(attribute, "this attribute is there twice")),
    }
}

/// `#[name = "text"]`.
pub(crate) fn text(attribute: &Attribute) -> Result<LitStr> {
    if let Meta::NameValue(pair) = &attribute.meta
        && let Expr::Lit(ExprLit { lit: Lit::Str(text), .. }) = &pair.value
    {
        return Ok(text.clone());
    }
    let name = attribute.path().get_ident().map(ToString::to_string).unwrap_or_default();
    Err(Error::new(attribute.span(), format!("write #[{name} = \"…\"]")))
}

/// `#[flag]`.
pub(crate) fn flag(attribute: &Attribute) -> Result<()> {
    match attribute.meta {
        Meta::Path(_) => Ok(()),
        _ => Err(Error::new(attribute.span(), "this attribute takes nothing")),
    }
}

/// `#[size(200)]`, `#[size(50, 32)]`.
fn sizes(attribute: &Attribute) -> Result<Vec<LitInt>> {
    let wrong =
        "write #[size(200)]: the most bytes or elements that there are, or #[size(50, 32)] for those of elements";
    let sizes = attribute
        .parse_args_with(Punctuated::<LitInt, Token![,]>::parse_separated_nonempty)
        .map_err(|_| Error::new(attribute.span(), wrong))?;
    for size in &sizes {
        if size.base10_parse::<u64>()? > LARGEST {
            return Err(Error::new(size.span(), "a size is a number of 32 bits"));
        }
    }
    Ok(sizes.into_iter().collect())
}
