//! Generates the server of an interface: plain functions that read arguments, call the trait, and set results.

use proc_macro2::TokenStream;
use quote::{format_ident, quote};

use crate::interface::{Function, Input, Interface, Results};

pub(crate) fn make(interface: &Interface, root: &TokenStream) -> TokenStream {
    let Interface { item, functions } = interface;
    let (visibility, name, holder) = (&item.vis, &item.ident, interface.holder());
    let server = format_ident!("{}Server", name);
    let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
    let actuators = interface.actuators();
    let about = format!("Adds the functions of [`{name}`] to the list of a unit whose state implements it.");
    let (declared, of_port) = if actuators.is_empty() {
        (quote!(#visibility struct #server;), quote!(#server))
    } else {
        let docs = actuators.iter().map(|actuator| format!("What makes safe what `{actuator}` is."));
        let fields = quote!(#(#[doc = #docs] pub #actuators: A),*);
        (quote!(#visibility struct #server<A> { #fields }), quote!(#server<F::Actuator>))
    };
    let bounds = functions.iter().filter_map(Function::call).map(|call| {
        let bounds = &call.bounds;
        quote!(F::Call: #bounds,)
    });
    let list =
        if functions.iter().any(|function| function.is_async) { quote!(AsyncFunctions) } else { quote!(Functions) };
    let readers = functions.iter().any(|function| function.only_reads).then(|| quote!(+ #typed::ReaderFunctions<T>));
    let debug = if actuators.is_empty() { quote!() } else { quote!(<A>) };
    let text = server.to_string();
    let serving = functions.iter().map(|function| serve(interface, function, root));
    let adding = functions.iter().map(|function| {
        let (signature, attributes, serve) = (
            function.constant("SIGNATURE"),
            function.constant("ATTRIBUTES"),
            format_ident!("serve_{}", function.ident),
        );
        let actuator = match &function.attributes.actuator {
            Some(actuator) => quote!(::core::option::Option::Some(&self.#actuator)),
            None => quote!(::core::option::Option::None),
        };
        let (add, run) = match (function.is_async, function.takes_state) {
            (true, _) => {
                (quote!(AsyncFunctions::<T>::add_task), quote!(#holder::#serve::<T, F::Call, F::State, F::Room>))
            }
            (false, true) if function.only_reads => {
                let method = quote! {
                    &|state: &mut T, call: &F::Call, parameters: &mut #parts::ParametersView| {
                        #holder::#serve::<T, F::Call>(state, call, parameters)
                    }
                };
                (quote!(ReaderFunctions::<T>::add_reader), quote!(&#holder::#serve::<T, F::Call>, #method))
            }
            (false, true) => (quote!(Functions::<T>::add_method), quote!(&#holder::#serve::<T, F::Call>)),
            (false, false) => (quote!(Functions::<T>::add_free), quote!(&#holder::#serve::<T, F::Call>)),
        };
        quote!(#typed::#add(functions, #holder::#signature, #holder::#attributes, #actuator, #run)?;)
    });
    quote! {
        #[doc = #about]
        #declared

        impl #debug ::core::fmt::Debug for #server #debug {
            fn fmt(&self, f: &mut ::core::fmt::Formatter<'_>) -> ::core::fmt::Result {
                f.write_str(#text)
            }
        }

        #[allow(dead_code)]
        impl #holder {
            #(#serving)*
        }

        impl<T, F> #typed::Interface<T, F> for #of_port
        where
            T: #name + 'static,
            F: #typed::#list<T> #readers + ?::core::marker::Sized,
            #(#bounds)*
        {
            fn add_to(self, functions: &F) -> ::core::result::Result<(), #parts::Error> {
                #(#adding)*
                ::core::result::Result::Ok(())
            }
        }
    }
}

fn serve(interface: &Interface, function: &Function, root: &TokenStream) -> TokenStream {
    let (name, ident, serve) = (&interface.item.ident, &function.ident, format_ident!("serve_{}", function.ident));
    let (typed, parts) = (quote!(#root::typed), quote!(#root::typed::parts));
    let (reads, passed) = arguments(function, root);
    let bounds = function.call().map(|call| {
        let bounds = &call.bounds;
        quote!(+ #bounds)
    });
    let question = function.can_fail.then(|| quote!(?));
    let writes = write_results(function, root);
    if function.is_async {
        return quote! {
            #[allow(unused_variables, clippy::unit_arg, clippy::let_unit_value)]
            async fn #serve<T: #name, C, S, R>(
                call: C,
                state: S,
                mut room: R,
            ) -> ::core::result::Result<R, #parts::ServiceError>
            where
                C: #typed::AnyCall + ::core::marker::Sync #bounds,
                S: #typed::AsyncState<T>,
                R: ::core::ops::DerefMut<Target = #parts::ParametersView>,
            {
                let parameters: &mut #parts::ParametersView = &mut room;
                #(#reads)*
                let results = <T as #name>::#ident(#(#passed),*).await #question;
                #writes
                ::core::result::Result::Ok(room)
            }
        };
    }
    let (state, receiver) = match (function.takes_state, function.only_reads) {
        (true, true) => (quote!(state: &T,), quote!(state,)),
        (true, false) => (quote!(state: &mut T,), quote!(state,)),
        (false, _) => (quote!(), quote!()),
    };
    quote! {
        #[allow(unused_variables, clippy::unit_arg, clippy::let_unit_value)]
        fn #serve<T: #name, C: #typed::AnyCall #bounds>(
            #state
            call: &C,
            parameters: &mut #parts::ParametersView,
        ) -> ::core::result::Result<(), #parts::ServiceError> {
            #(#reads)*
            let results = <T as #name>::#ident(#receiver #(#passed),*)#question;
            #writes
            ::core::result::Result::Ok(())
        }
    }
}

/// Code that reads the arguments, and the arguments of the trait's method.
fn arguments(function: &Function, root: &TokenStream) -> (Vec<TokenStream>, Vec<TokenStream>) {
    let typed = quote!(#root::typed);
    let mut place = 0;
    let mut reads = Vec::new();
    let mut passed = Vec::new();
    for input in &function.inputs {
        match input {
            Input::Call(call) if call.is_state => passed.push(quote!(&state)),
            Input::Call(_) if function.is_async => passed.push(quote!(&call)),
            Input::Call(_) => passed.push(quote!(call)),
            Input::Variable(_, variable) => {
                let read = variable.argument(root, place);
                let local = format_ident!("argument_{}", place);
                place += 1;
                reads.push(quote!(let #local = #read?;));
                passed.push(quote!(#local));
            }
            Input::Struct(_, rust) => {
                reads.push(quote! {
                    let arguments = <#rust as #typed::Variables>::read_places(parameters, &#typed::IN_ORDER)
                        .map_err(#typed::refused)?;
                });
                passed.push(quote!(arguments));
            }
        }
    }
    (reads, passed)
}

/// Code that sets the results at their indexes in parameters made from the signature.
fn write_results(function: &Function, root: &TokenStream) -> TokenStream {
    let (holder_places, typed) = (function.constant("PLACES"), quote!(#root::typed));
    match &function.results {
        Results::Struct(rust) if matches!(**rust, syn::Type::Tuple(_)) => quote!(),
        Results::Struct(_) => quote!(#typed::Variables::write_places(&results, parameters, &Self::#holder_places)?;),
        Results::Named(results) => {
            let is_tuple = results.len() > 1;
            let each = results.iter().enumerate().map(|(index, result)| {
                let at = syn::Index::from(index);
                let value = if is_tuple { quote!(results.#at) } else { quote!(results) };
                let place = quote!(#typed::place(&Self::#holder_places, #index));
                let write = result.write(root, &value, &place);
                quote!(#write?;)
            });
            quote!(#(#each)*)
        }
    }
}
