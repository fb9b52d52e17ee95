//! Generates the client of an interface, and a request type for each of its functions.

use proc_macro2::TokenStream;
use quote::{format_ident, quote};
use syn::{Ident, Lifetime, Type};

use crate::interface::{Function, Input, Interface, Results};
use crate::kind::Variable;

pub(crate) fn make(interface: &Interface, root: &TokenStream) -> TokenStream {
    let requests = interface.functions.iter().map(|function| request(interface, function, root));
    let client = client(interface, root);
    quote! {
        #(#requests)*
        #client
    }
}

/// The name of a function's request type.
fn name(interface: &Interface, function: &Function) -> Ident {
    format_ident!("__{}_{}", interface.item.ident, crate::attributes::plain(&function.ident))
}

/// The request type of a function: its arguments, and how they are encoded and results decoded.
fn request(interface: &Interface, function: &Function, root: &TokenStream) -> TokenStream {
    let (typed, parts, holder) = (quote!(#root::typed), quote!(#root::typed::parts), interface.holder());
    let (visibility, name) = (&interface.item.vis, name(interface, function));
    let (inputs, names, lifetime) = (inputs(function), names(function), lifetime(function));
    let [arguments, results, signature] =
        ["ARGUMENTS", "RESULTS", "SIGNATURE"].map(|constant| function.constant(constant));
    let (writes, read, returned) = (writes(function, root), read(interface, function, root), function.returned());
    let (progress, fails) =
        function.reported().map_or((quote!(()), quote!(())), |(reported, fails)| (quote!(#reported), quote!(#fails)));
    let bytes = quote!(#typed::parameters_bytes(#holder::#arguments, #holder::#results) + #typed::ROOM);
    let room = quote!(::core::ops::DerefMut<Target = #parts::ParametersView> + ::core::marker::Unpin);
    let result = |ok: TokenStream| quote!(::core::result::Result<#ok, #parts::Error>);
    let (opened, read_as) = (result(quote!(())), result(quote!(#returned)));
    quote! {
        #[doc(hidden)]
        #[allow(non_camel_case_types, dead_code, missing_debug_implementations)]
        #visibility struct #name #lifetime {
            #(#inputs),*
        }

        #[allow(unused_variables, clippy::needless_question_mark)]
        impl #lifetime #typed::Request for #name #lifetime {
            type Results = #returned;
            type Progress<'v> = #progress;
            type Failure = #fails;
            type Frame<R: #room> = #typed::Frame<{ #typed::on_stack(#bytes) }, R, Self>;

            #[inline]
            fn frame<R: #room>(self) -> Self::Frame<R> {
                #typed::Frame::new(#holder::#signature, self)
            }

            fn open<C: #parts::Caller>(frame: &mut Self::Frame<C::Room>) -> #opened {
                if let ::core::option::Option::Some((Self { #(#names),* }, parameters)) = frame.lay_out::<C>(#bytes)? {
                    #(#writes)*
                }
                ::core::result::Result::Ok(())
            }

            fn parts<R: #room>(frame: &mut Self::Frame<R>) -> (#parts::Callee<'_>, &mut #parts::ParametersView) {
                frame.parts()
            }

            fn results<R: #room>(frame: &Self::Frame<R>) -> #read_as {
                let parameters: &#parts::ParametersView = frame;
                #read
            }

            fn progress(values: &#parts::ParametersView) -> ::core::option::Option<#progress> {
                <#progress as #typed::Variables>::from_parameters(values).ok()
            }
        }
    }
}

/// Sets the variables from the arguments.
fn writes(function: &Function, root: &TokenStream) -> Vec<TokenStream> {
    let typed = quote!(#root::typed);
    let mut place = 0_usize;
    let writes = function.inputs.iter().filter_map(|input| match input {
        Input::Call(_) => None,
        Input::Variable(argument, variable) => {
            let write = variable.write(root, &quote!(#argument), &quote!(#place));
            place += 1;
            Some(quote!(#write?;))
        }
        Input::Struct(argument, _) => {
            Some(quote!(#typed::Variables::write_places(&#argument, parameters, &#typed::IN_ORDER)?;))
        }
    });
    writes.collect()
}

/// Reads the results from the variables.
fn read(interface: &Interface, function: &Function, root: &TokenStream) -> TokenStream {
    let typed = quote!(#root::typed);
    let (holder, places) = (interface.holder(), function.constant("PLACES"));
    match &function.results {
        Results::Struct(rust) => quote!(<#rust as #typed::Variables>::read_places(parameters, &#holder::#places)),
        Results::Named(results) => {
            let read = |(index, result): (usize, &Variable)| {
                result.read(root, &quote!(#typed::place(&#holder::#places, #index)))
            };
            let reads = results.iter().enumerate().map(read).collect::<Vec<_>>();
            match reads.as_slice() {
                [only] => only.clone(),
                several => quote!(::core::result::Result::Ok((#(#several?),*))),
            }
        }
    }
}

/// `<'a>` if the function has borrowed arguments.
fn lifetime(function: &Function) -> Option<TokenStream> {
    let is_borrowed = |input: &Input| matches!(input, Input::Variable(_, variable) if variable.is_borrowed());
    function.inputs.iter().any(is_borrowed).then(|| quote!(<'a>))
}

/// The arguments of the client's method.
fn inputs(function: &Function) -> Vec<TokenStream> {
    let input = |input: &Input| match input {
        Input::Call(_) => None,
        Input::Variable(name, variable) => {
            let mut rust = variable.rust.clone();
            if let Type::Reference(reference) = &mut rust {
                reference.lifetime = Some(Lifetime::new("'a", proc_macro2::Span::call_site()));
            }
            Some(quote!(#name: #rust))
        }
        Input::Struct(name, rust) => Some(quote!(#name: #rust)),
    };
    function.inputs.iter().filter_map(input).collect()
}

/// The names of the arguments.
fn names(function: &Function) -> Vec<TokenStream> {
    let name = |input: &Input| match input {
        Input::Call(_) => None,
        Input::Variable(name, _) | Input::Struct(name, _) => Some(quote!(#name)),
    };
    function.inputs.iter().filter_map(name).collect()
}

fn client(interface: &Interface, root: &TokenStream) -> TokenStream {
    let (visibility, interface_name) = (&interface.item.vis, &interface.item.ident);
    let client = format_ident!("{interface_name}Client");
    let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
    let about = format!(
        "Calls the functions of [`{interface_name}`] at a peer: `.wait()` for threads, `.await` for tasks, `.send()` without waiting."
    );
    let methods = interface.functions.iter().map(|function| {
        let (ident, request) = (&function.ident, name(interface, function));
        let (inputs, names, lifetime, help) = (inputs(function), names(function), lifetime(function), help(function));
        quote! {
            #[doc = #help]
            #visibility fn #ident #lifetime (&self, #(#inputs),*) -> #parts::Call<'p, P, #request #lifetime> {
                self.client.call(#request { #(#names),* })
            }
        }
    });
    quote! {
        #[doc = #about]
        #[allow(dead_code)]
        #visibility struct #client<'p, P> {
            client: #typed::Client<'p, P>,
        }

        impl<P> ::core::clone::Clone for #client<'_, P> {
            fn clone(&self) -> Self {
                *self
            }
        }

        impl<P> ::core::marker::Copy for #client<'_, P> {}

        impl<P: ::core::fmt::Debug> ::core::fmt::Debug for #client<'_, P> {
            fn fmt(&self, f: &mut ::core::fmt::Formatter<'_>) -> ::core::fmt::Result {
                ::core::fmt::Debug::fmt(&self.client, f)
            }
        }

        #[allow(dead_code, clippy::too_many_arguments)]
        impl<'p, P: #parts::Caller> #client<'p, P> {
            /// Calls at this peer, with the default options.
            #visibility const fn at(peer: &'p P) -> Self {
                Self { client: #typed::Client::at(peer) }
            }

            /// Calls with these options from here on.
            #visibility const fn with(self, options: #parts::RequestOptions) -> Self {
                Self { client: self.client.with(options) }
            }

            /// Calls whose motion is wanted so long.
            #visibility const fn renewing(self, renew: #parts::Renew) -> Self {
                Self { client: self.client.renewing(renew) }
            }

            #(#methods)*
        }
    }
}

/// The documentation of a client's method.
fn help(function: &Function) -> String {
    // Do not use `#[help]` here: it may be a peer's text (`--rust`), in which rustdoc would run code.
    if function.about.is_empty() { format!("Calls `{}`.", function.name) } else { function.about.clone() }
}
