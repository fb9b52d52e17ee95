//! Attributes of fields, arguments and functions, as the macros parse them.

use syn::punctuated::Punctuated;
use syn::spanned::Spanned;
use syn::{Attribute, Error, Expr, ExprLit, Ident, Lit, LitInt, LitStr, Meta, Result, Token};

/// Largest size that can be declared, of text, bytes or a list.
const LARGEST: u64 = u32::MAX as u64;
/// As in `cara_core::config`, where this crate cannot look; the core checks the result.
const HELP_BYTES: usize = 160;

/// `#[size(200)]`, `#[name = "…"]` and `#[unit = "m"]` of a variable.
#[derive(Default)]
pub(crate) struct OfVariable {
    /// The sizes in `#[size(50, 32)]`: of a list, then of its elements.
    pub(crate) size: Vec<LitInt>,
    pub(crate) name: Option<String>,
    pub(crate) unit: Option<LitStr>,
}

impl OfVariable {
    /// Takes these attributes out of a list.
    pub(crate) fn take(attributes: &mut Vec<Attribute>) -> Result<Self> {
        let mut found = Self::default();
        let mut size = None;
        for attribute in extract(attributes, &["size", "name", "unit"]) {
            if attribute.path().is_ident("size") {
                set(&mut size, sizes(&attribute)?, &attribute)?;
            } else if attribute.path().is_ident("name") {
                set(&mut found.name, text(&attribute)?.value(), &attribute)?;
            } else {
                set(&mut found.unit, text(&attribute)?, &attribute)?;
            }
        }
        found.size = size.unwrap_or_default();
        Ok(found)
    }

    /// The name, or by default the Rust name.
    pub(crate) fn name_or(&mut self, ident: &Ident) -> String {
        self.name.take().unwrap_or_else(|| plain(ident))
    }
}

/// An identifier without `r#`.
pub(crate) fn plain(ident: &Ident) -> String {
    let text = ident.to_string();
    text.strip_prefix("r#").map_or(text.clone(), str::to_owned)
}

/// Whether an attribute has one of these names.
pub(crate) fn is_one_of(attribute: &Attribute, names: &[&str]) -> bool {
    names.iter().any(|name| attribute.path().is_ident(name))
}

/// Takes the attributes with these names out of a list.
pub(crate) fn extract(attributes: &mut Vec<Attribute>, names: &[&str]) -> Vec<Attribute> {
    extract_if(attributes, |attribute| is_one_of(attribute, names))
}

/// Takes the attributes that `is_wanted` accepts out of a list.
pub(crate) fn extract_if(attributes: &mut Vec<Attribute>, is_wanted: impl FnMut(&Attribute) -> bool) -> Vec<Attribute> {
    let (taken, kept) = std::mem::take(attributes).into_iter().partition(is_wanted);
    *attributes = kept;
    taken
}

/// Sets an attribute that may be given only once.
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

/// The first paragraph of the documentation, as one line, cut to the length of a line of help.
pub(crate) fn first_line(attributes: &[Attribute]) -> String {
    let text = |attribute: &Attribute| match &attribute.meta {
        Meta::NameValue(pair) if attribute.path().is_ident("doc") => match &pair.value {
            Expr::Lit(ExprLit { lit: Lit::Str(text), .. }) => Some(text.value()),
            _ => None,
        },
        _ => None,
    };
    let text = attributes.iter().filter_map(text).collect::<Vec<_>>().join("\n");
    let lines = text.lines().map(str::trim).skip_while(|line| line.is_empty());
    let paragraph = lines.take_while(|line| !line.is_empty()).collect::<Vec<_>>().join(" ");
    if paragraph.len() <= HELP_BYTES {
        return paragraph;
    }
    let whole = paragraph.floor_char_boundary(HELP_BYTES - '…'.len_utf8());
    let kept = paragraph[..whole].rsplit_once(' ').map_or(&paragraph[..whole], |(words, _)| words);
    format!("{kept}…")
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
