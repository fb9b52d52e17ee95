//! The clients of an interface: one for threads that wait, one for tasks that await.

use proc_macro2::TokenStream;
use quote::{format_ident, quote};

use crate::interface::{Function, Input, Interface, Results};
use crate::kind::Variable;

pub(crate) fn make(interface: &Interface, root: &TokenStream) -> TokenStream {
    let Interface { functions, .. } = interface;
    let holder = interface.holder();
    let shared = functions.iter().map(|function| shared(function, root));
    let blocking = client(interface, root, "Client", "for threads: a call returns when it has its results", blocking);
    let awaited = client(interface, root, "AsyncClient", "for tasks: a call is awaited", awaited);
    quote! {
        #[allow(dead_code, clippy::needless_question_mark)]
        impl #holder {
            #(#shared)*
        }
        #blocking
        #awaited
    }
}

/// What both clients do for a function: variables with the arguments in them, and results out of them.
fn shared(function: &Function, root: &TokenStream) -> TokenStream {
    let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
    let (fill, take) = (format_ident!("fill_{}", function.ident), format_ident!("take_{}", function.ident));
    let inputs = inputs(function);
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
    let writes = writes.collect::<Vec<_>>();
    let (places, returned) = (function.constant("PLACES"), function.returned());
    let results = match &function.results {
        Results::Struct(rust) => quote!(<#rust as #typed::Variables>::read_places(parameters, &Self::#places)),
        Results::Named(results) => {
            let read =
                |(index, result): (usize, &Variable)| result.read(root, &quote!(#typed::place(&Self::#places, #index)));
            let reads = results.iter().enumerate().map(read).collect::<Vec<_>>();
            match reads.as_slice() {
                [only] => only.clone(),
                several => quote!(::core::result::Result::Ok((#(#several?),*))),
            }
        }
    };
    quote! {
        #[allow(unused_variables, clippy::too_many_arguments, clippy::needless_question_mark)]
        fn #fill(parameters: &mut #parts::ParametersView, #(#inputs),*) -> ::core::result::Result<(), #parts::Error> {
            #(#writes)*
            ::core::result::Result::Ok(())
        }

        #[allow(unused_variables, clippy::needless_question_mark)]
        fn #take(parameters: &#parts::ParametersView) -> ::core::result::Result<#returned, #parts::Error> {
            #results
        }
    }
}

/// The arguments as a client takes them.
fn inputs(function: &Function) -> Vec<TokenStream> {
    let input = |input: &Input| match input {
        Input::Call(_) => None,
        Input::Variable(name, variable) => {
            let rust = &variable.rust;
            Some(quote!(#name: #rust))
        }
        Input::Struct(name, rust) => Some(quote!(#name: #rust)),
    };
    function.inputs.iter().filter_map(input).collect()
}

/// Their names.
fn names(function: &Function) -> Vec<TokenStream> {
    let name = |input: &Input| match input {
        Input::Call(_) => None,
        Input::Variable(name, _) | Input::Struct(name, _) => Some(quote!(#name)),
    };
    function.inputs.iter().filter_map(name).collect()
}

fn client(
    interface: &Interface,
    root: &TokenStream,
    suffix: &str,
    about: &str,
    methods: fn(&Interface, &Function, &TokenStream) -> TokenStream,
) -> TokenStream {
    let Interface { item, functions } = interface;
    let (visibility, name) = (&item.vis, &item.ident);
    let client = format_ident!("{}{}", name, suffix);
    let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
    let about = format!("Calls the functions of [`{name}`] at a peer, {about}.");
    let bound = format_ident!("{}", if suffix == "Client" { "BlockingCaller" } else { "AwaitedCaller" });
    let each = functions.iter().map(|function| methods(interface, function, root));
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
        impl<'p, P: #typed::#bound> #client<'p, P> {
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

            #(#each)*
        }
    }
}

/// The variables of a call, prepared and filled.
fn prepared(interface: &Interface, function: &Function, root: &TokenStream) -> TokenStream {
    let (typed, parts, holder) = (quote!(#root::typed), quote!(#root::typed::parts), interface.holder());
    let (arguments, results, signature) =
        (function.constant("ARGUMENTS"), function.constant("RESULTS"), function.constant("SIGNATURE"));
    let (fill, names) = (format_ident!("fill_{}", function.ident), names(function));
    quote! {
        const BYTES: usize = #typed::parameters_bytes(#holder::#arguments, #holder::#results) + #typed::ROOM;
        let mut on_stack = #parts::Parameters::<{ #typed::on_stack(BYTES) }>::sized();
        let mut room = if BYTES > #typed::STACK_BYTES { <P as #typed::Caller>::room(BYTES) } else { ::core::option::Option::None };
        let parameters: &mut #parts::ParametersView = match &mut room {
            ::core::option::Option::Some(room) => room,
            ::core::option::Option::None => &mut on_stack,
        };
        self.client.prepare(#holder::#signature, parameters)?;
        #holder::#fill(parameters, #(#names),*)?;
    }
}

/// The documentation of a call.
fn help(function: &Function) -> String {
    // A line of help that is an attribute may be another node's, which is no documentation: rustdoc would run code in it.
    if function.about.is_empty() { format!("Calls `{}`.", function.name) } else { function.about.clone() }
}

fn blocking(interface: &Interface, function: &Function, root: &TokenStream) -> TokenStream {
    let (typed, holder, visibility) = (quote!(#root::typed), interface.holder(), &interface.item.vis);
    let (ident, name, take) = (&function.ident, &function.name, format_ident!("take_{}", function.ident));
    let (inputs, returned, prepared, help) =
        (inputs(function), function.returned(), prepared(interface, function, root), help(function));
    let hold = function.attributes.lease.as_ref().map(|_| {
        let hold = format_ident!("hold_{}", crate::attributes::plain(ident));
        let about = format!(
            "As [`{ident}`](Self::{ident}); what the call has started goes on until what is returned, which has the results, is dropped."
        );
        quote! {
            #[doc = #about]
            #visibility fn #hold(&self, #(#inputs),*) -> ::core::result::Result<#typed::Held<P::Hold, #returned>, #typed::CallError> {
                #prepared
                let hold = #typed::BlockingCaller::block_and_hold(self.client.peer(), #name, parameters, self.client.options())?;
                ::core::result::Result::Ok(#typed::Held { results: #holder::#take(parameters)?, hold })
            }
        }
    });
    let watch = watch(interface, function, root, false);
    let request = request(interface, function, root);
    quote! {
        #[doc = #help]
        #visibility fn #ident(&self, #(#inputs),*) -> ::core::result::Result<#returned, #typed::CallError> {
            #prepared
            #typed::BlockingCaller::block(self.client.peer(), #name, parameters, self.client.options())?;
            ::core::result::Result::Ok(#holder::#take(parameters)?)
        }
        #watch
        #request
        #hold
    }
}

/// The call with its progress and its reasons, where the function declares them.
fn watch(interface: &Interface, function: &Function, root: &TokenStream, is_awaited: bool) -> Option<TokenStream> {
    let (progress, fails) = function.told()?;
    let (typed, holder, visibility) = (quote!(#root::typed), interface.holder(), &interface.item.vis);
    let (ident, name, take) = (&function.ident, &function.name, format_ident!("take_{}", function.ident));
    let (inputs, returned, prepared) = (inputs(function), function.returned(), prepared(interface, function, root));
    let watch = format_ident!("watch_{}", crate::attributes::plain(ident));
    let about = format!(
        "As [`{ident}`](Self::{ident}), with what the call tells while it runs, and all that the service says of a failure. `Break` \
         gives the call up: it ends with `Error::Cancelled`, and what it has started stops."
    );
    let (asyncness, watcher, method, wait) = match is_awaited {
        true => (quote!(async), quote!(AwaitedWatcher), quote!(call_watched), quote!(.await)),
        false => (quote!(), quote!(WatchingCaller), quote!(block_watched), quote!()),
    };
    let failed = quote!(#typed::Failed<#fails>);
    Some(quote! {
        #[doc = #about]
        #[allow(clippy::result_large_err)]
        #visibility #asyncness fn #watch(
            &self,
            #(#inputs,)*
            mut on_progress: impl ::core::ops::FnMut(#progress) -> ::core::ops::ControlFlow<()>,
        ) -> ::core::result::Result<#returned, #failed>
        where
            P: #typed::#watcher,
        {
            #prepared
            let (mut why, options) = (::core::option::Option::None, self.client.options());
            let hand = |told: &#typed::parts::ParametersView| #typed::hand(told, &mut on_progress);
            #typed::#watcher::#method(self.client.peer(), #name, parameters, options, hand, &mut why)#wait
                .map_err(|error| <#failed>::new(error, why.as_ref()))?;
            ::core::result::Result::Ok(#holder::#take(parameters)?)
        }
    })
}

fn request(interface: &Interface, function: &Function, root: &TokenStream) -> TokenStream {
    let (typed, parts, visibility) = (quote!(#root::typed), quote!(#root::typed::parts), &interface.item.vis);
    let (ident, name) = (&function.ident, &function.name);
    let (inputs, prepared) = (inputs(function), prepared(interface, function, root));
    let request = format_ident!("request_{}", crate::attributes::plain(ident));
    let about = format!("As [`{ident}`](Self::{ident}), without waiting: accepted, not sent, not executed.");
    quote! {
        #[doc = #about]
        #visibility fn #request(&self, #(#inputs),*) -> ::core::result::Result<#parts::CallId, #typed::CallError> {
            #prepared
            let call = #typed::Caller::send(self.client.peer(), #name, parameters, self.client.options())?;
            ::core::result::Result::Ok(call)
        }
    }
}

fn awaited(interface: &Interface, function: &Function, root: &TokenStream) -> TokenStream {
    let (typed, holder, visibility) = (quote!(#root::typed), interface.holder(), &interface.item.vis);
    let (ident, name, take) = (&function.ident, &function.name, format_ident!("take_{}", function.ident));
    let (inputs, returned, prepared, help) =
        (inputs(function), function.returned(), prepared(interface, function, root), help(function));
    let watch = watch(interface, function, root, true);
    let request = request(interface, function, root);
    quote! {
        #[doc = #help]
        #visibility async fn #ident(&self, #(#inputs),*) -> ::core::result::Result<#returned, #typed::CallError> {
            #prepared
            #typed::AwaitedCaller::call(self.client.peer(), #name, parameters, self.client.options()).await?;
            ::core::result::Result::Ok(#holder::#take(parameters)?)
        }
        #watch
        #request
    }
}
