//! One variable: its name, its Rust type, and code that reads and sets it.

use proc_macro2::{TokenStream, TokenTree};
use quote::{ToTokens, quote, quote_spanned};
use syn::spanned::Spanned;
use syn::{Error, GenericArgument, LitInt, LitStr, PathArguments, Result, Type};

use crate::attributes::OfVariable;

/// A variable, declared by a field, an argument or a result.
pub(crate) struct Variable {
    /// Its name in the signature.
    pub(crate) name: String,
    pub(crate) rust: Type,
    pub(crate) kind: Kind,
    unit: Option<LitStr>,
}

/// How a Rust type becomes a variable.
pub(crate) enum Kind {
    /// It implements `Field`.
    Field,
    /// `String` or `&str` of at most this many bytes.
    Text(LitInt),
    /// `Vec<u8>` or `&[u8]` of at most this many bytes.
    Bytes(LitInt),
    /// A list of at most this many elements.
    List(Holder, TokenStream, Box<Variable>),
}

/// The Rust type of a list.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Holder {
    /// `Vec`.
    Growing,
    /// `heapless::Vec`.
    Bounded,
    /// `Option`.
    Optional,
}

/// What the spelling of a type says.
enum Spelling {
    Text,
    Bytes,
    /// A list of elements of this type, and the most elements if the type says that.
    List(Holder, Box<Type>, Option<TokenStream>),
    Other,
}

impl Variable {
    /// A variable, or an error about its type.
    pub(crate) fn new(name: String, rust: Type, said: OfVariable) -> Result<Self> {
        let mut sizes = said.size.into_iter();
        let variable = Self::nested(name, rust, &mut sizes)?;
        match sizes.next() {
            None => Ok(Self { unit: said.unit, ..variable }),
            Some(size) => {
                let wrong = match variable.kind {
                    Kind::Field => "only `String`, `&str`, `Vec` and `&[u8]` have a #[size]",
                    _ => "this type does not have so many sizes",
                };
                Err(Error::new(size.span(), wrong))
            }
        }
    }

    /// Consumes the sizes that it needs, from the outermost type to the innermost.
    fn nested(name: String, rust: Type, sizes: &mut impl Iterator<Item = LitInt>) -> Result<Self> {
        let mut size = |what: &str| {
            let wrong = || format!("say how many {what} of `{}` there are at most: #[size(200)]", spelled(&rust));
            sizes.next().ok_or_else(|| Error::new_spanned(&rust, wrong()))
        };
        let kind = match spelling(&rust)? {
            Spelling::Text => Kind::Text(size("bytes")?),
            Spelling::Bytes => Kind::Bytes(size("bytes")?),
            Spelling::Other => Kind::Field,
            Spelling::List(holder, element, most) => {
                let most = match most {
                    Some(most) => most,
                    None => size("elements")?.into_token_stream(),
                };
                if let Type::Reference(_) = *element {
                    return Err(Error::new_spanned(element, "a list owns its elements"));
                }
                Kind::List(holder, most, Box::new(Self::nested(String::new(), *element, sizes)?))
            }
        };
        Ok(Self { name, rust, kind, unit: None })
    }

    /// Its name and unit, if it has a unit.
    pub(crate) fn unit(&self) -> Option<TokenStream> {
        let (name, unit) = (&self.name, self.unit.as_ref()?);
        Some(quote!((#name, #unit)))
    }

    /// Whether the type is a reference.
    pub(crate) const fn is_borrowed(&self) -> bool {
        matches!(self.rust, Type::Reference(_))
    }

    /// An expression of its `VariableSpec`.
    pub(crate) fn spec(&self, root: &TokenStream) -> TokenStream {
        let Self { name, rust, kind, .. } = self;
        let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
        match kind {
            Kind::Field => {
                let field = quote!(<#rust as #typed::Field>);
                quote! {
                    #parts::VariableSpec { name: #name, kind: #field::KIND, size: #field::SIZE, inner: #field::INNER }
                }
            }
            Kind::Text(size) => quote!(#parts::VariableSpec::flat(#name, #parts::Type::String, #size)),
            Kind::Bytes(size) => quote!(#parts::VariableSpec::flat(#name, #parts::Type::Bytes, #size)),
            Kind::List(_, most, element) => {
                let element = element.spec(root);
                let spec = quote! {{
                    const ELEMENT: #parts::VariableSpec<'static> = #element;
                    const INNER: [u8; #typed::element_bytes(ELEMENT)] = #typed::element(ELEMENT);
                    #parts::VariableSpec {
                        name: #name,
                        kind: #parts::Type::List,
                        size: (#most) as u32,
                        inner: &INNER,
                    }
                }};
                self.list(root, &spec)
            }
        }
    }

    /// Code that reads it, of type `Result<_, Error>`.
    pub(crate) fn read(&self, root: &TokenStream, place: &TokenStream) -> TokenStream {
        let read = self.reader(root);
        quote!(parameters.value_of(#place).and_then(#read))
    }

    /// A closure from its `Value` to a `Result<_, Error>`.
    pub(crate) fn reader(&self, root: &TokenStream) -> TokenStream {
        let rust = &self.rust;
        let from = |borrowed: TokenStream| {
            quote!(|value| {
                <#borrowed as #root::typed::parts::FromValue>::from_value(value).map(<#rust as ::core::convert::From<#borrowed>>::from)
            })
        };
        match &self.kind {
            Kind::Field => quote!(<#rust as #root::typed::Field>::from_field),
            Kind::Text(_) => from(quote!(&str)),
            Kind::Bytes(_) => from(quote!(&[u8])),
            Kind::List(holder, _, element) => {
                let read = element.reader(root);
                match holder {
                    Holder::Growing => quote!(|value| {
                        #root::typed::elements(value).and_then(|elements| elements.map(#read).collect())
                    }),
                    Holder::Bounded => quote!(|value| {
                        let mut list = <#rust>::new();
                        for element in #root::typed::elements(value)?.map(#read) {
                            list.push(element?).map_err(|_| #root::typed::parts::Error::OutOfRange)?;
                        }
                        ::core::result::Result::Ok(list)
                    }),
                    Holder::Optional => quote!(|value| {
                        #root::typed::optional(value).and_then(|element| element.map(#read).transpose())
                    }),
                }
            }
        }
    }

    /// Code that reads it for a service, of type `Result<_, ServiceError>`.
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
            Kind::List(..) => {
                let read = self.read(root, &quote!(#place));
                let error = quote!(#root::typed::parts::Error);
                quote!({
                    let read: ::core::result::Result<#rust, #error> = #read;
                    read.map_err(#root::typed::refused)
                })
            }
        }
    }

    /// Code that sets it from an expression, of type `Result<(), Error>`.
    pub(crate) fn write(&self, root: &TokenStream, value: &TokenStream, place: &TokenStream) -> TokenStream {
        let write = self.writer(root, value);
        quote!(parameters.slot_of(#place).and_then(|slot| #write))
    }

    /// Code that sets the target `slot`, of type `Result<(), Error>`.
    pub(crate) fn writer(&self, root: &TokenStream, value: &TokenStream) -> TokenStream {
        let rust = &self.rust;
        match &self.kind {
            Kind::Field => quote!(<#rust as #root::typed::Field>::to_field(&#value, slot)),
            Kind::Text(_) | Kind::Bytes(_) => quote!(slot.set(&#value[..])),
            Kind::List(_, _, element) => {
                let write = element.writer(root, &quote!((*element)));
                let write = quote!(slot.list(|list| {
                    for element in #value.iter() {
                        list.push_with(|slot| #write)?;
                    }
                    ::core::result::Result::Ok(())
                }));
                self.list(root, &write)
            }
        }
    }

    /// An expression for a list: an error at its type if the core is built without lists.
    fn list(&self, root: &TokenStream, list: &TokenStream) -> TokenStream {
        let span = self.rust.span();
        let here = |mut token: TokenTree| {
            token.set_span(span);
            token
        };
        let root: TokenStream = root.clone().into_iter().map(here).collect();
        quote_spanned!(span => #root::typed::__list!(#list))
    }
}

/// The type as written, for messages.
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
                ("Vec", [Some(only)]) => Ok(Spelling::List(Holder::Growing, Box::new((*only).clone()), None)),
                ("Vec", [Some(element), most]) if !is_u8(element) => {
                    let wrong =
                        || Error::new_spanned(rust, "of vectors `Vec<T>` and `heapless::Vec<T, N>` are variables");
                    let most = most.as_ref().map(ToTokens::to_token_stream).or_else(|| bound(&last.arguments));
                    Ok(Spelling::List(Holder::Bounded, Box::new((*element).clone()), Some(most.ok_or_else(wrong)?)))
                }
                ("Option", [Some(only)]) => {
                    Ok(Spelling::List(Holder::Optional, Box::new((*only).clone()), Some(quote!(1))))
                }
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

/// The generic arguments; `None` for each that is not a type.
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

/// The second generic argument, if it is a number.
fn bound(arguments: &PathArguments) -> Option<TokenStream> {
    let PathArguments::AngleBracketed(generic) = arguments else { return None };
    match generic.args.get(1)? {
        GenericArgument::Const(number) => Some(number.to_token_stream()),
        _ => None,
    }
}
