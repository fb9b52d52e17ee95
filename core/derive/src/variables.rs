//! `#[derive(Variables)]`.

use proc_macro2::TokenStream;
use quote::{format_ident, quote};
use syn::spanned::Spanned;
use syn::{Data, DataEnum, DeriveInput, Error, Fields, FieldsNamed, Ident, Result, parse_quote};

use crate::attributes::{OfVariable, first_line};
use crate::kind::Variable;

/// The implementation for a struct or an enum, or an error.
pub(crate) fn derive(input: TokenStream, root: &TokenStream) -> TokenStream {
    syn::parse2(input).and_then(|input| implement(input, root)).unwrap_or_else(Error::into_compile_error)
}

fn implement(input: DeriveInput, root: &TokenStream) -> Result<TokenStream> {
    if !input.generics.params.is_empty() {
        return Err(Error::new_spanned(input.generics, "what derives `Variables` owns its data and has no generics"));
    }
    match input.data {
        Data::Struct(data) => match data.fields {
            Fields::Named(fields) => of_struct(&input.ident, fields, &first_line(&input.attrs), root),
            fields => Err(Error::new(
                if fields.is_empty() { input.ident.span() } else { fields.span() },
                "variables have names: make it a struct with named fields",
            )),
        },
        Data::Enum(data) if data.variants.iter().any(|variant| !matches!(variant.fields, Fields::Unit)) => {
            of_choice(&input.ident, data, root)
        }
        Data::Enum(data) => of_enum(&input.ident, &data, root),
        Data::Union(union) => {
            Err(Error::new_spanned(union.union_token, "a union cannot be variables: make it a struct"))
        }
    }
}

fn of_struct(ident: &Ident, fields: FieldsNamed, help: &str, root: &TokenStream) -> Result<TokenStream> {
    let mut names = Vec::new();
    let mut variables = Vec::new();
    for mut field in fields.named {
        let Some(name) = field.ident.take() else { continue };
        let mut said = OfVariable::take(&mut field.attrs)?;
        let variable = Variable::new(said.name_or(&name), field.ty, said)?;
        if variable.is_borrowed() {
            let wrong =
                "a struct of variables owns its data: use `String` or `heapless::String<N>`, or a vector of `u8`";
            return Err(Error::new_spanned(variable.rust, wrong));
        }
        names.push(name);
        variables.push(variable);
    }
    let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
    let taken = variables.iter().zip(&names).map(|(variable, field)| {
        let (name, read) = (&variable.name, variable.reader(root));
        quote!(#field: fields.take(#name).and_then(#read)?)
    });
    let set = variables.iter().zip(&names).map(|(variable, field)| {
        let (name, write) = (&variable.name, variable.writer(root, &quote!(self.#field)));
        quote!(record.set_with(#name, |slot| #write)?;)
    });
    let specs = variables.iter().map(|variable| variable.spec(root));
    let units = variables.iter().filter_map(Variable::unit);
    let places = (0..variables.len()).map(|index| quote!(#root::typed::place(places, #index))).collect::<Vec<_>>();
    let reads = variables.iter().zip(&places).map(|(variable, place)| variable.read(root, place));
    let writes = variables
        .iter()
        .zip(&places)
        .zip(&names)
        .map(|((variable, place), name)| variable.write(root, &quote!(self.#name), place));
    let (parameters, error) = (quote!(#root::typed::parts::ParametersView), quote!(#root::typed::parts::Error));
    let inner = inner_of(root, &quote!(<#ident as #typed::Variables>::SPECS));
    Ok(quote! {
        #[automatically_derived]
        impl #root::typed::Variables for #ident {
            const SPECS: &'static [#root::typed::parts::VariableSpec<'static>] = &[#(#specs),*];
            const UNITS: #root::typed::Units = &[#(#units),*];
            const HELP: &'static str = #help;

            fn read_places(parameters: &#parameters, places: &[u8]) -> ::core::result::Result<Self, #error> {
                ::core::result::Result::Ok(Self { #(#names: #reads?),* })
            }

            fn write_places(&self, parameters: &mut #parameters, places: &[u8]) -> ::core::result::Result<(), #error> {
                #(#writes?;)*
                ::core::result::Result::Ok(())
            }

            fn with_parameters<R>(&self, look: impl FnOnce(&#parameters) -> R) -> ::core::result::Result<R, #error> {
                const BYTES: usize =
                    #root::typed::parameters_bytes(&[], <#ident as #root::typed::Variables>::SPECS);
                let mut parameters = #root::typed::parts::Parameters::<BYTES>::sized();
                #root::typed::Variables::to_parameters(self, &mut parameters)?;
                ::core::result::Result::Ok(look(&parameters))
            }
        }

        #typed::__nested! {
            #[automatically_derived]
            impl #typed::Field for #ident {
                const KIND: #parts::Type = #parts::Type::Record;
                const SIZE: u32 = <Self as #typed::Variables>::SPECS.len() as u32;
                const INNER: &'static [u8] = #inner;

                fn from_field(value: #parts::Value<'_>) -> ::core::result::Result<Self, #error> {
                    let mut fields = #typed::Record::of(value)?;
                    ::core::result::Result::Ok(Self { #(#taken),* })
                }

                fn to_field(&self, slot: #parts::Slot<'_>) -> ::core::result::Result<(), #error> {
                    slot.record(|record| {
                        #(#set)*
                        ::core::result::Result::Ok(())
                    })
                }
            }
        }
    })
}

/// The inner types of a record with these fields.
fn inner_of(root: &TokenStream, fields: &TokenStream) -> TokenStream {
    let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
    quote! {{
        const FIELDS: &[#parts::VariableSpec<'static>] = #fields;
        const INNER: [u8; #typed::fields_bytes(FIELDS)] = match #typed::fields(FIELDS) {
            ::core::result::Result::Ok(inner) => inner,
            ::core::result::Result::Err(rule) => ::core::panic!("{}", rule),
        };
        &INNER
    }}
}

/// An enum each of whose variants has one value: a record of optional fields, of which exactly one is present.
fn of_choice(ident: &Ident, data: DataEnum, root: &TokenStream) -> Result<TokenStream> {
    let mut names = Vec::new();
    let mut variables = Vec::new();
    for mut variant in data.variants {
        let rust = match &variant.fields {
            Fields::Unnamed(fields) if fields.unnamed.len() == 1 => fields.unnamed.first().map(|field| &field.ty),
            _ => None,
        };
        let Some(rust) = rust else {
            let wrong =
                "the variants of an enum that is a variable have one unnamed value each, or none of them has any";
            return Err(Error::new_spanned(variant, wrong));
        };
        let rust = parse_quote!(::core::option::Option<#rust>);
        let mut said = OfVariable::take(&mut variant.attrs)?;
        variables.push(Variable::new(said.name_or(&variant.ident), rust, said)?);
        names.push(variant.ident);
    }
    let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
    let (result, error) = (quote!(::core::result::Result), quote!(#root::typed::parts::Error));
    let specs = variables.iter().map(|variable| variable.spec(root));
    let inner = inner_of(root, &quote!(&[#(#specs),*]));
    let count = variables.len() as u32;
    let taken = variables.iter().zip(&names).map(|(variable, variant)| {
        let (name, rust, read) = (&variable.name, &variable.rust, variable.reader(root));
        quote! {
            let one: #rust = fields.take(#name).and_then(#read)?;
            if one.is_some_and(|one| chosen.replace(Self::#variant(one)).is_some()) {
                return #result::Err(#error::OutOfRange);
            }
        }
    });
    let set = variables.iter().zip(&names).map(|(variable, variant)| {
        let one = quote! {
            (match self { Self::#variant(one) => ::core::slice::from_ref(one), _ => &[] })
        };
        let (name, write) = (&variable.name, variable.writer(root, &one));
        quote!(record.set_with(#name, |slot| #write)?;)
    });
    Ok(quote! {
        #typed::__nested! {
            #[automatically_derived]
            impl #typed::Field for #ident {
                const KIND: #parts::Type = #parts::Type::Record;
                const SIZE: u32 = #count;
                const INNER: &'static [u8] = #inner;

                fn from_field(value: #parts::Value<'_>) -> #result<Self, #error> {
                    let mut fields = #typed::Record::of(value)?;
                    let mut chosen = ::core::option::Option::None;
                    #(#taken)*
                    chosen.ok_or(#error::OutOfRange)
                }

                #[allow(unreachable_patterns)]
                fn to_field(&self, slot: #parts::Slot<'_>) -> #result<(), #error> {
                    slot.record(|record| {
                        #(#set)*
                        #result::Ok(())
                    })
                }
            }
        }
    })
}

fn of_enum(ident: &Ident, data: &DataEnum, root: &TokenStream) -> Result<TokenStream> {
    if data.variants.is_empty() {
        return Err(Error::new_spanned(ident, "an enum that is a variable has a variant at least"));
    }
    let variants = data.variants.iter().map(|variant| &variant.ident).collect::<Vec<_>>();
    let numbers = variants.iter().map(|variant| format_ident!("NUMBER_OF_{}", variant)).collect::<Vec<_>>();
    let (field, error) = (quote!(#root::typed::Field), quote!(#root::typed::parts::Error));
    let result = quote!(::core::result::Result);
    Ok(quote! {
        #[automatically_derived]
        impl #field for #ident {
            const KIND: #root::typed::parts::Type = #root::typed::parts::Type::Int;
            const SIZE: u32 = 1;

            #[allow(non_upper_case_globals)]
            fn from_field(value: #root::typed::parts::Value<'_>) -> #result<Self, #error> {
                #(const #numbers: i64 = #ident::#variants as i64;)*
                match <i64 as #field>::from_field(value)? {
                    #(#numbers => #result::Ok(Self::#variants),)*
                    _ => #result::Err(#error::OutOfRange),
                }
            }

            fn to_field(&self, slot: #root::typed::parts::Slot<'_>) -> #result<(), #error> {
                let number = match self {
                    #(Self::#variants => Self::#variants as i64,)*
                };
                <i64 as #field>::to_field(&number, slot)
            }
        }
    })
}
