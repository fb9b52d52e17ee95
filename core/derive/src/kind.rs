//! One variable: its name, its Rust type, and how that is read and set.

use proc_macro2::TokenStream;
use quote::{ToTokens, quote};
use syn::{Error, GenericArgument, LitInt, PathArguments, Result, Type};

/// A variable as a field, an argument or a result declares it.
pub(crate) struct Variable {
    /// Its name in the signature.
    pub(crate) name: String,
    pub(crate) rust: Type,
    pub(crate) kind: Kind,
}

/// How a Rust type is a variable.
pub(crate) enum Kind {
    /// By the trait `Field`.
    Field,
    /// `String` or `&str`, of at most so many bytes.
    Text(LitInt),
    /// `Vec<u8>` or `&[u8]`, likewise.
    Bytes(LitInt),
}

/// What the spelling of a type tells.
enum Spelling {
    Text,
    Bytes,
    Other,
}

impl Variable {
    /// Or what is wrong with its type.
    pub(crate) fn new(name: String, rust: Type, size: Option<LitInt>) -> Result<Self> {
        let kind = match (spelling(&rust)?, size) {
            (Spelling::Text, Some(size)) => Kind::Text(size),
            (Spelling::Bytes, Some(size)) => Kind::Bytes(size),
            (Spelling::Other, None) => Kind::Field,
            (Spelling::Text | Spelling::Bytes, None) => {
                let wrong = format!("say how many bytes of `{}` there are at most: #[size(200)]", spelled(&rust));
                return Err(Error::new_spanned(rust, wrong));
            }
            (Spelling::Other, Some(size)) => {
                return Err(Error::new(size.span(), "only `String`, `&str`, `Vec<u8>` and `&[u8]` have a #[size]"));
            }
        };
        Ok(Self { name, rust, kind })
    }

    /// Whether it is borrowed.
    pub(crate) const fn is_borrowed(&self) -> bool {
        matches!(self.rust, Type::Reference(_))
    }

    /// Its `VariableSpec`.
    pub(crate) fn spec(&self, root: &TokenStream) -> TokenStream {
        let Self { name, rust, kind } = self;
        let (kind, size) = match kind {
            Kind::Field => {
                let field = quote!(<#rust as #root::typed::Field>);
                (quote!(#field::KIND), quote!(#field::SIZE))
            }
            Kind::Text(size) => (quote!(#root::typed::parts::Type::String), size.to_token_stream()),
            Kind::Bytes(size) => (quote!(#root::typed::parts::Type::Bytes), size.to_token_stream()),
        };
        quote!(#root::typed::parts::VariableSpec { name: #name, kind: #kind, size: #size })
    }

    /// Reads it, as a `Result<_, Error>`.
    pub(crate) fn read(&self, root: &TokenStream, place: &TokenStream) -> TokenStream {
        let rust = &self.rust;
        let value = quote!(parameters.value_of(#place));
        let from = |borrowed: TokenStream| {
            quote!(#value.and_then(|value| {
                <#borrowed as #root::typed::parts::FromValue>::from_value(value).map(<#rust as ::core::convert::From<#borrowed>>::from)
            }))
        };
        match self.kind {
            Kind::Field => quote!(#value.and_then(<#rust as #root::typed::Field>::from_field)),
            Kind::Text(_) => from(quote!(&str)),
            Kind::Bytes(_) => from(quote!(&[u8])),
        }
    }

    /// Reads it for a service, as a `Result<_, ServiceError>`.
    pub(crate) fn argument(&self, root: &TokenStream, place: usize) -> TokenStream {
        let rust = &self.rust;
        match self.kind {
            Kind::Field => quote!(#root::typed::argument::<#rust>(parameters, #place)),
            Kind::Text(_) => {
                quote!(#root::typed::borrowed::<&str>(parameters, #place).map(<#rust as ::core::convert::From<&str>>::from))
            }
            Kind::Bytes(_) => {
                quote!(#root::typed::borrowed::<&[u8]>(parameters, #place).map(<#rust as ::core::convert::From<&[u8]>>::from))
            }
        }
    }

    /// Sets it from an expression, as a `Result<(), Error>`.
    pub(crate) fn write(&self, root: &TokenStream, value: &TokenStream, place: &TokenStream) -> TokenStream {
        let rust = &self.rust;
        let target = quote!(parameters.target_of(#place));
        match self.kind {
            Kind::Field => quote!(#target.and_then(|target| <#rust as #root::typed::Field>::to_field(&#value, target))),
            Kind::Text(_) | Kind::Bytes(_) => {
                quote!(#target.and_then(|target| #root::typed::parts::IntoValue::into_value(&#value[..], target)))
            }
        }
    }
}

/// The type as it is written, for messages.
fn spelled(rust: &Type) -> String {
    rust.to_token_stream().to_string().replace(' ', "")
}

fn spelling(rust: &Type) -> Result<Spelling> {
    match rust {
        Type::Reference(reference) if reference.mutability.is_some() => {
            Err(Error::new_spanned(rust, "a variable is no `&mut`: what a service changes is a result"))
        }
        Type::Reference(reference) => match &*reference.elem {
            Type::Path(path) if path.path.is_ident("str") => Ok(Spelling::Text),
            Type::Slice(slice) if is_u8(&slice.elem) => Ok(Spelling::Bytes),
            _ => Err(Error::new_spanned(rust, "of references only `&str` and `&[u8]` are variables")),
        },
        Type::Path(path) => {
            let Some(last) = path.path.segments.last() else { return Ok(Spelling::Other) };
            let generic = generic_types(&last.arguments);
            match (last.ident.to_string().as_str(), generic.as_slice()) {
                ("String", []) => Ok(Spelling::Text),
                ("Vec", [Some(only)]) if is_u8(only) => Ok(Spelling::Bytes),
                ("Vec", [_]) => Err(Error::new_spanned(
                    rust,
                    "lists cannot be variables yet: use an array of a fixed length, or `Vec<u8>` for bytes",
                )),
                ("Option", _) => Err(Error::new_spanned(
                    rust,
                    "an `Option` cannot be a variable yet: use a `bool` and a value, or two functions",
                )),
                _ => Ok(Spelling::Other),
            }
        }
        Type::Tuple(tuple) => Err(Error::new_spanned(
            tuple,
            "a tuple cannot be a variable: each variable has a name, so make them several",
        )),
        _ => Ok(Spelling::Other),
    }
}

fn is_u8(rust: &Type) -> bool {
    matches!(rust, Type::Path(path) if path.path.is_ident("u8"))
}

/// The generic arguments, `None` for each that is no type.
fn generic_types(arguments: &PathArguments) -> Vec<Option<&Type>> {
    match arguments {
        PathArguments::AngleBracketed(generic) => generic
            .args
            .iter()
            .map(|argument| match argument {
                GenericArgument::Type(rust) => Some(rust),
                _ => None,
            })
            .collect(),
        _ => Vec::new(),
    }
}
