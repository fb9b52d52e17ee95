//! `#[interface]`: parses the trait, checks its rules, and puts the generated parts together.

use proc_macro2::{Span, TokenStream, TokenTree};
use quote::{ToTokens, format_ident, quote, quote_spanned};
use syn::parse::{Parse, ParseStream};
use syn::punctuated::Punctuated;
use syn::spanned::Spanned;
use syn::{
    Attribute, Error, FnArg, GenericArgument, Ident, ItemTrait, LitStr, Pat, PathArguments, Result, ReturnType, Token,
    TraitItem, TraitItemFn, Type, TypeParamBound,
};

use crate::attributes::{OfVariable, extract, first_line, flag, plain, set, text};
use crate::calling::Attributes;
use crate::kind::Variable;
use crate::{client, server};

/// A parsed trait.
pub(crate) struct Interface {
    pub(crate) item: ItemTrait,
    pub(crate) functions: Vec<Function>,
}

/// A function of the trait.
pub(crate) struct Function {
    pub(crate) ident: Ident,
    /// Its name in the signature.
    pub(crate) name: String,
    pub(crate) takes_state: bool,
    /// It takes the state as `&self`.
    pub(crate) only_reads: bool,
    pub(crate) is_async: bool,
    pub(crate) inputs: Vec<Input>,
    pub(crate) results: Results,
    /// It returns a `Result`.
    pub(crate) can_fail: bool,
    pub(crate) attributes: Attributes,
    /// The first paragraph of its documentation.
    pub(crate) about: String,
    /// The line of help that is published.
    pub(crate) help: String,
}

/// An argument of a function.
pub(crate) enum Input {
    /// `call`, or the state of an `async fn`.
    Call(Call),
    Variable(Ident, Variable),
    /// A struct whose fields are the arguments.
    Struct(Ident, Type),
}

/// An argument that is not a variable: `call` or `state`.
pub(crate) struct Call {
    /// It is `state`.
    pub(crate) is_state: bool,
    /// The traits after `impl`, for a state of type `T`.
    pub(crate) bounds: TokenStream,
    /// The types in `TypedCall<Left, Blocked>`: the progress, and the values of failures.
    reported: Vec<Type>,
}

/// The results of a function.
pub(crate) enum Results {
    /// A type that has the names, such as `()`.
    Struct(Box<Type>),
    /// One result or, as a tuple, several, with names in `#[returns(…)]`.
    Named(Vec<Variable>),
}

/// The trait with everything generated from it, or an error.
pub(crate) fn expand(attribute: TokenStream, input: TokenStream, root: &TokenStream) -> TokenStream {
    let made = || {
        if !attribute.is_empty() {
            return Err(Error::new_spanned(&attribute, "#[interface] takes nothing"));
        }
        let interface = Interface::read(syn::parse2(input)?)?;
        let (item, constants) = (&interface.item, constants(&interface, root));
        let (server, client) = (server::make(&interface, root), client::make(&interface, root));
        Ok(quote!(#item #constants #server #client))
    };
    made().unwrap_or_else(Error::into_compile_error)
}

impl Interface {
    fn read(mut item: ItemTrait) -> Result<Self> {
        if !item.generics.params.is_empty() {
            return Err(Error::new_spanned(
                item.generics,
                "an interface has no generics: peers know one signature of each function",
            ));
        }
        let mut functions = Vec::new();
        for member in &mut item.items {
            match member {
                TraitItem::Fn(function) => functions.push(Function::read(function)?),
                // Such as the type of an order, which differs between ports.
                TraitItem::Type(_) => {}
                other => return Err(Error::new_spanned(other, "an interface has functions only")),
            }
        }
        if functions.is_empty() {
            return Err(Error::new_spanned(&item.ident, "an interface has a function at least"));
        }
        Ok(Self { item, functions })
    }

    /// The type with the constants of the functions.
    pub(crate) fn holder(&self) -> Ident {
        format_ident!("__{}Functions", self.item.ident)
    }

    /// All actuators that functions move, stop or reset, without duplicates.
    pub(crate) fn actuators(&self) -> Vec<&Ident> {
        let mut found: Vec<&Ident> = Vec::new();
        for actuator in self.functions.iter().filter_map(|function| function.attributes.actuator.as_ref()) {
            if !found.contains(&actuator) {
                found.push(actuator);
            }
        }
        found
    }
}

impl Function {
    fn read(item: &mut TraitItemFn) -> Result<Self> {
        let signature = &mut item.sig;
        if !signature.generics.params.is_empty() {
            return Err(Error::new_spanned(&signature.generics, "a function of an interface has no generics"));
        }
        let ident = signature.ident.clone();
        let mut returns = None;
        let (mut name, mut help) = (None, None);
        let attributes = Attributes::take(&mut item.attrs)?;
        for attribute in extract(&mut item.attrs, &["returns", "name", "help"]) {
            match attribute.path().get_ident().map(ToString::to_string).unwrap_or_default().as_str() {
                "returns" => set(
                    &mut returns,
                    attribute.parse_args_with(Punctuated::<Named, Token![,]>::parse_terminated)?,
                    &attribute,
                )?,
                "name" => set(&mut name, text(&attribute)?.value(), &attribute)?,
                _ => set(&mut help, text(&attribute)?.value(), &attribute)?,
            }
        }
        let is_async = signature.asyncness.is_some();
        let (mut takes_state, mut only_reads) = (false, false);
        let mut inputs = Vec::new();
        for input in &mut signature.inputs {
            match input {
                FnArg::Receiver(receiver) if receiver.reference.is_none() => {
                    return Err(Error::new_spanned(
                        receiver,
                        "a function of an interface takes `&mut self`, `&self`, or no self at all",
                    ));
                }
                FnArg::Receiver(receiver) if is_async => {
                    let wrong = "an `async fn` has the state for moments only: take `state: &impl AsyncState<Self>`";
                    return Err(Error::new_spanned(receiver, wrong));
                }
                FnArg::Receiver(receiver) => (takes_state, only_reads) = (true, receiver.mutability.is_none()),
                FnArg::Typed(argument) => inputs.push(Input::read(&argument.pat, &argument.ty, &mut argument.attrs)?),
            }
        }
        let span = signature.ident.span();
        let reports = |input: &&Input| matches!(input, Input::Call(call) if !call.is_state);
        if inputs.iter().filter(reports).count() > 1 {
            return Err(Error::new(
                span,
                "a function has one argument that tells about its call: join the bounds with `+`",
            ));
        }
        let variables = inputs.iter().filter(|input| !matches!(input, Input::Call(_))).count();
        if variables > 1 && inputs.iter().any(|input| matches!(input, Input::Struct(..))) {
            return Err(Error::new(span, "an argument with #[variables] is the only one"));
        }
        let (results, can_fail) = read_results(&signature.output, returns)?;
        let about = first_line(&item.attrs);
        let help = help.unwrap_or_else(|| about.clone());
        let name = name.unwrap_or_else(|| plain(&ident));
        let function =
            Self { ident, name, takes_state, only_reads, is_async, inputs, results, can_fail, attributes, about, help };
        function.check(span)?;
        make_future(item);
        Ok(function)
    }

    /// Checks rules about combinations of attributes.
    fn check(&self, span: Span) -> Result<()> {
        let Attributes { priority, lease, actuator, .. } = &self.attributes;
        let (stops, resets) = (self.attributes.has("stop"), self.attributes.has("reset"));
        let emergency = priority.as_ref().filter(|priority| *priority == "emergency");
        if let (Some(priority), true) = (emergency, self.takes_state) {
            let wrong = "an emergency service waits for nothing, and so does not get the state: take no self";
            return Err(Error::new(priority.span(), wrong));
        }
        if let (Some(priority), true) = (emergency, self.is_async) {
            let wrong = "an emergency service waits for nothing, and so is no `async fn`";
            return Err(Error::new(priority.span(), wrong));
        }
        if !self.is_async && self.inputs.iter().any(|input| matches!(input, Input::Call(call) if call.is_state)) {
            return Err(Error::new(span, "an `async fn` alone takes the state so: take `&mut self`"));
        }
        if let (Some(lease), None) = (lease, actuator) {
            return Err(Error::new(lease.span(), "a lease is of what moves: name it with #[actuator(drive)]"));
        }
        if let (Some(actuator), None, false, false) = (actuator, lease, stops, resets) {
            let wrong = "what moves an actuator has a lease, as #[lease(ms = 400)]; or say #[stop] or #[reset]";
            return Err(Error::new(actuator.span(), wrong));
        }
        if stops && resets {
            return Err(Error::new(span, "a function stops or resets, not both"));
        }
        Ok(())
    }

    /// Arguments and results that are declared one by one.
    fn variables(&self) -> impl Iterator<Item = &Variable> {
        let results: &[Variable] = match &self.results {
            Results::Named(results) => results,
            Results::Struct(_) => &[],
        };
        let arguments = self.inputs.iter().filter_map(|input| match input {
            Input::Variable(_, variable) => Some(variable),
            Input::Call(_) | Input::Struct(..) => None,
        });
        arguments.chain(results)
    }

    /// The structs whose fields are variables of the function.
    fn structs(&self) -> Vec<Type> {
        let arguments = self.inputs.iter().filter_map(|input| match input {
            Input::Struct(_, rust) => Some(rust.clone()),
            Input::Call(_) | Input::Variable(..) => None,
        });
        let results = match &self.results {
            Results::Struct(rust) => Some((**rust).clone()),
            Results::Named(_) => None,
        };
        let reported = self.reported().map(|(progress, fails)| [progress, fails]);
        arguments.chain(results).chain(reported.into_iter().flatten()).collect()
    }

    /// The argument `call`, if there is one.
    pub(crate) fn call(&self) -> Option<&Call> {
        self.inputs.iter().find_map(|input| match input {
            Input::Call(call) if !call.is_state => Some(call),
            Input::Call(_) | Input::Variable(..) | Input::Struct(..) => None,
        })
    }

    /// The types of the progress and of failure values; `None` if neither is declared.
    pub(crate) fn reported(&self) -> Option<(Type, Type)> {
        let reported = &self.call()?.reported;
        let second = || reported.get(1).cloned().unwrap_or_else(|| syn::parse_quote!(()));
        Some((reported.first()?.clone(), second()))
    }

    /// The name of a constant of this function.
    pub(crate) fn constant(&self, what: &str) -> Ident {
        format_ident!("{}_{}", what, plain(&self.ident))
    }

    /// The Rust type of the results, without `Result`.
    pub(crate) fn returned(&self) -> TokenStream {
        match &self.results {
            Results::Struct(rust) => rust.to_token_stream(),
            Results::Named(results) => match results.as_slice() {
                [only] => only.rust.to_token_stream(),
                several => {
                    let types = several.iter().map(|result| &result.rust);
                    quote!((#(#types),*))
                }
            },
        }
    }
}

impl Input {
    fn read(pattern: &Pat, rust: &Type, attributes: &mut Vec<Attribute>) -> Result<Self> {
        let Pat::Ident(pattern) = pattern else {
            return Err(Error::new_spanned(pattern, "an argument has a name, which is the variable's"));
        };
        if let Type::Reference(reference) = rust
            && let Type::ImplTrait(call) = &*reference.elem
        {
            let is_state = call.bounds.iter().any(lends_state);
            let reported = call.bounds.iter().flat_map(types_of).collect();
            let bounds = call.bounds.to_token_stream().into_iter().map(of_state).collect();
            return Ok(Self::Call(Call { is_state, bounds, reported }));
        }
        let is_struct = extract(attributes, &["variables"]);
        let mut said = OfVariable::take(attributes)?;
        if let Some(attribute) = is_struct.first() {
            flag(attribute)?;
            return Ok(Self::Struct(pattern.ident.clone(), rust.clone()));
        }
        let name = said.name_or(&pattern.ident);
        Ok(Self::Variable(pattern.ident.clone(), Variable::new(name, rust.clone(), said)?))
    }
}

/// Turns an `async fn` into one that returns a `Send` future, for any executor; its borrows are `Send`, too. Implementations
/// write `async fn`, and `&impl AnyCall` like the trait.
fn make_future(item: &mut TraitItemFn) {
    let signature = &mut item.sig;
    let Some(word) = signature.asyncness.take() else { return };
    for input in &mut signature.inputs {
        if let FnArg::Typed(argument) = input
            && let Type::Reference(reference) = &mut *argument.ty
            && let Type::ImplTrait(call) = &*reference.elem
            && !call.bounds.iter().any(lends_state)
        {
            let bounds = &call.bounds;
            *reference.elem = syn::parse_quote!((impl #bounds + ::core::marker::Sync));
        }
    }
    let rust = match &signature.output {
        ReturnType::Default => syn::parse_quote!(()),
        ReturnType::Type(_, rust) => (**rust).clone(),
    };
    let future = quote_spanned!(word.span() => impl ::core::future::Future<Output = #rust> + ::core::marker::Send);
    signature.output = syn::parse_quote!(-> #future);
    if let Some(body) = &item.default {
        item.default = Some(syn::parse_quote!({ async move #body }));
    }
}

/// Whether the bound is `AsyncState<Self>`.
fn lends_state(bound: &TypeParamBound) -> bool {
    let TypeParamBound::Trait(bound) = bound else { return false };
    bound.path.segments.last().is_some_and(|last| last.ident == "AsyncState")
}

/// Replaces `Self` of the trait by `T`, the state in the server's functions.
fn of_state(token: TokenTree) -> TokenTree {
    match token {
        TokenTree::Ident(word) if word == "Self" => Ident::new("T", word.span()).into(),
        other => other,
    }
}

/// `Left` and `Blocked` of `TypedCall<Left, Blocked>`.
fn types_of(bound: &TypeParamBound) -> Vec<Type> {
    let TypeParamBound::Trait(bound) = bound else { return Vec::new() };
    match bound.path.segments.last().map(|last| &last.arguments) {
        Some(PathArguments::AngleBracketed(generic)) => generic
            .args
            .iter()
            .filter_map(|argument| match argument {
                GenericArgument::Type(rust) => Some(rust.clone()),
                _ => None,
            })
            .collect(),
        _ => Vec::new(),
    }
}

/// The name of a result, such as `sum`, `"pos-x"` or `#[size(64)] text`.
struct Named {
    name: String,
    span: Span,
    said: OfVariable,
}

impl Parse for Named {
    fn parse(input: ParseStream<'_>) -> Result<Self> {
        let mut attributes = input.call(Attribute::parse_outer)?;
        let said = OfVariable::take(&mut attributes)?;
        let span = input.span();
        let name = if input.peek(LitStr) { input.parse::<LitStr>()?.value() } else { plain(&input.parse()?) };
        Ok(Self { name, span, said })
    }
}

/// Parses the results, and whether the function can fail.
fn read_results(output: &ReturnType, returns: Option<Punctuated<Named, Token![,]>>) -> Result<(Results, bool)> {
    let unit = || syn::parse_quote!(());
    let (rust, can_fail) = match output {
        ReturnType::Default => (unit(), false),
        ReturnType::Type(_, rust) => match of_result(rust) {
            Some(rust) => (rust, true),
            None => ((**rust).clone(), false),
        },
    };
    let Some(names) = returns else {
        return match &rust {
            Type::Tuple(tuple) if !tuple.elems.is_empty() => {
                Err(Error::new_spanned(tuple, "name the results above the function: #[returns(x, y)]"))
            }
            Type::Reference(reference) => {
                Err(Error::new_spanned(reference, "a result is owned: it outlives the call that made it"))
            }
            _ => Ok((Results::Struct(Box::new(rust)), can_fail)),
        };
    };
    let types: Vec<Type> = match (&rust, names.len()) {
        (Type::Tuple(tuple), _) => tuple.elems.iter().cloned().collect(),
        _ => vec![rust.clone()],
    };
    if types.len() != names.len() {
        let wrong = format!("#[returns] names {} results, and the function gives {}", names.len(), types.len());
        return Err(Error::new_spanned(rust, wrong));
    }
    let mut results = Vec::new();
    for (Named { name, span, said }, rust) in names.into_iter().zip(types) {
        if let Type::Reference(reference) = &rust {
            return Err(Error::new_spanned(reference, "a result is owned: it outlives the call that made it"));
        }
        let result = Variable::new(name, rust, said).map_err(|error| {
            let mut error = error;
            error.combine(Error::new(span, "this result"));
            error
        });
        results.push(result?);
    }
    Ok((Results::Named(results), can_fail))
}

/// The first type of a `Result<…>`.
fn of_result(rust: &Type) -> Option<Type> {
    let Type::Path(path) = rust else { return None };
    let last = path.path.segments.last().filter(|segment| segment.ident == "Result")?;
    let PathArguments::AngleBracketed(generic) = &last.arguments else { return None };
    match generic.args.first()? {
        GenericArgument::Type(rust) => Some(rust.clone()),
        _ => None,
    }
}

/// Constants: signatures, and indexes of results.
fn constants(interface: &Interface, root: &TokenStream) -> TokenStream {
    let Interface { item, functions } = interface;
    let (visibility, holder) = (&item.vis, interface.holder());
    let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
    let each = functions.iter().map(|function| {
        let name = &function.name;
        let named = |what: &str| function.constant(what);
        let (arguments, results, places) = (named("ARGUMENTS"), named("RESULTS"), named("PLACES"));
        let declared = named("DECLARED");
        let (encoded, signature, attributes) = (named("ENCODED"), named("SIGNATURE"), named("ATTRIBUTES"));
        let of_arguments = match function.inputs.iter().find_map(|input| match input {
            Input::Struct(_, rust) => Some(rust),
            Input::Call(_) | Input::Variable(..) => None,
        }) {
            Some(rust) => quote!(<#rust as #typed::Variables>::SPECS),
            None => {
                let specs = function.inputs.iter().filter_map(|input| match input {
                    Input::Variable(_, variable) => Some(variable.spec(root)),
                    Input::Call(_) | Input::Struct(..) => None,
                });
                quote!(&[#(#specs),*])
            }
        };
        let of_results = match &function.results {
            Results::Struct(rust) => quote!(<#rust as #typed::Variables>::SPECS),
            Results::Named(results) => {
                let specs = results.iter().map(|result| result.spec(root));
                quote!(&[#(#specs),*])
            }
        };
        let (progress, fails) = match function.reported() {
            Some((progress, fails)) => {
                let specs = |rust: Type| quote_spanned! { rust.span() => <#rust as #typed::Variables>::SPECS };
                (specs(progress), specs(fails))
            }
            None => (quote!(&[]), quote!(&[])),
        };
        let (help, units) = (&function.help, function.variables().filter_map(Variable::unit));
        let of_structs = function.structs().into_iter().map(|rust| quote!(<#rust as #typed::Variables>::UNITS));
        let values = function.attributes.expression(root);
        let span = function.ident.span();
        let made = quote_spanned! { span =>
            match #typed::Encoded::new(#name, Self::#declared) {
                ::core::result::Result::Ok(encoded) => encoded,
                ::core::result::Result::Err(rule) => ::core::panic!("{}", rule),
            }
        };
        quote! {
            const #arguments: &'static [#parts::VariableSpec<'static>] = #of_arguments;
            const #results: &'static [#parts::VariableSpec<'static>] = #of_results;
            const #places: [u8; #typed::IN_ORDER.len()] = #typed::places_of_results(Self::#arguments, Self::#results);
            const #declared: #typed::Declared<'static> = #typed::Declared {
                arguments: Self::#arguments,
                results: Self::#results,
                progress: #progress,
                fails: #fails,
                help: #help,
                units: &[&[#(#units),*], #(#of_structs),*],
            };
            const #encoded: &'static #typed::Encoded<{ Self::#declared.encoded_bytes(#name) }> = &#made;
            const #signature: #parts::Signature<'static> = Self::#encoded.signature();
            const #attributes: #parts::Attributes = #values;
        }
    });
    quote! {
        #[doc(hidden)]
        #[allow(non_camel_case_types)]
        #visibility struct #holder;

        #[allow(non_upper_case_globals, dead_code)]
        impl #holder {
            #(#each)*
        }
    }
}
