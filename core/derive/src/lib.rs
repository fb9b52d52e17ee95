//! The macros of CARA's typed services: `#[derive(Variables)]` for structs and enums, and `#[interface]`, which makes a
//! server and a client of a trait.
//!
//! Use them as exported by `cara_core`, `cara_std` or `cara_embassy` (feature `derive`): the three forms of each macro differ
//! only in the crate that the generated code names.

mod attributes;
mod calling;
mod client;
mod interface;
mod kind;
mod server;
mod variables;

use proc_macro::TokenStream;
use quote::quote;

/// As `cara_core::Variables`: the fields of a struct are variables by their names, an enum without fields is one integer.
///
/// ```
/// use cara_core::Variables;
/// use cara_core::distribution::parameters::Parameters;
///
/// #[derive(Variables, Debug, PartialEq)]
/// struct Target {
///     #[unit = "m"]
///     position: [f64; 2],
///     fast: bool,
/// }
///
/// let target = Target { position: [1.5, 2.0], fast: true };
/// let mut parameters = Parameters::new();
/// target.to_parameters(&mut parameters)?;
/// assert_eq!(parameters.variable::<[f64; 2]>("position")?, [1.5, 2.0]);
/// assert_eq!(Target::from_parameters(&parameters)?, target);
/// # Ok::<(), cara_core::error::Error>(())
/// ```
///
/// With the feature `nested` of the core, which Linux has always, a field that is such a struct itself is a record, `Vec<T>`
/// and `heapless::Vec<T, N>` are lists, and `Option<T>` is a list of one at most.
///
/// | attribute of a field | means |
/// |---|---|
/// | `#[size(200)]` | how many bytes a `String` or `Vec<u8>`, or elements a `Vec<T>`, has at most; `#[size(50, 32)]` for a `Vec<String>` |
/// | `#[name = "x-1"]` | the variable's name, where it is not the field's |
/// | `#[unit = "m"]` | its unit, for people |
#[proc_macro_derive(Variables, attributes(size, name, unit))]
pub fn variables(input: TokenStream) -> TokenStream {
    variables::derive(input.into(), &quote!(::cara_core)).into()
}

/// The same, as `cara_std::Variables`.
#[proc_macro_derive(VariablesStd, attributes(size, name, unit))]
pub fn variables_std(input: TokenStream) -> TokenStream {
    variables::derive(input.into(), &quote!(::cara_std)).into()
}

/// The same, as `cara_embassy::Variables`.
#[proc_macro_derive(VariablesEmbassy, attributes(size, name, unit))]
pub fn variables_embassy(input: TokenStream) -> TokenStream {
    variables::derive(input.into(), &quote!(::cara_embassy)).into()
}

/// As `cara_core::interface`: makes `DriveServer` and `DriveClient` of a trait `Drive`.
///
/// ```
/// use cara_core::error::ServiceError;
/// use cara_core::interface;
///
/// /// What a vehicle offers. Its state implements this, a port's list of functions serves `AgvServer`, and
/// /// `AgvClient::at(&peer)` has a method of the same name for each function.
/// #[interface]
/// trait Agv {
///     /// Tells where it is, in metres.
///     #[idempotent]
///     #[returns(#[unit = "m"] position)]
///     fn position(&mut self) -> [f64; 2];
///
///     /// Shows a text.
///     fn show(&mut self, #[size(40)] text: &str) -> Result<(), ServiceError>;
/// }
/// ```
///
/// What moves has an actuator and a lease. This function also declares progress and the values of its failures:
///
/// ```
/// use cara_core::{ServiceError, TypedCall, Variables, interface};
///
/// #[derive(Variables)]
/// struct Left { metres: f64 }
///
/// #[derive(Variables)]
/// struct Blocked { at: f64 }
///
/// #[interface]
/// trait Drive {
///     #[actuator(drive)]
///     #[lease(ms = 400)]
///     fn go_to(&mut self, call: &impl TypedCall<Left, Blocked>, #[unit = "m"] x: f64) -> Result<(), ServiceError>;
///
///     #[priority(emergency)]
///     #[actuator(drive)]
///     #[stop]
///     fn stop();
/// }
///
/// struct Vehicle { x: f64, target: f64 }
///
/// impl Drive for Vehicle {
///     fn go_to(&mut self, call: &impl TypedCall<Left, Blocked>, x: f64) -> Result<(), ServiceError> {
///         if x > 100.0 {
///             return Err(call.fail_with(1, "the hall ends at 100 m", &Blocked { at: self.x }));
///         }
///         // Nothing changes if the order has ended meanwhile.
///         call.commit(|| self.target = x)?;
///         call.progress(&Left { metres: x - self.x })?;
///         Ok(())
///     }
///
///     // Empty: the unit itself has ended the orders before this runs.
///     fn stop() {}
/// }
/// ```
///
/// | attribute of a function | means |
/// |---|---|
/// | `#[returns(sum)]` | the names of the results; not needed for `()` and for structs that derive `Variables` |
/// | `#[priority(high)]` | the class of calls that name none: `emergency`, `high`, `normal`, `low` |
/// | `#[actuator(drive)]` | what it moves, stops or resets, which the server is made with |
/// | `#[lease(ms = 400)]` | how long it moves it after the caller's last sign that it wants it |
/// | `#[stop]`, `#[reset]` | it stops, or lets move again, its actuator or, without one, all |
/// | `#[idempotent]` | running it twice is as good as running it once |
/// | `#[help = "…"]` | what it does, in a line for people; the first paragraph of its documentation otherwise. Every peer that may see the function reads it: `#[help = ""]` keeps it back |
/// | `#[name = "go-to"]` | its name, where it is not the method's |
///
/// Arguments have `#[size(200)]`, `#[name = "…"]` and `#[unit = "m"]` as fields do, and names of results too: `#[returns(#[unit = "%"] charge)]`. One
/// argument alone may be `#[variables] order: Order`, whose fields are the arguments then. An argument `call: &impl AnyCall` tells
/// about the call; where its bounds need types that differ from port to port, the trait declares them (`type Order;`).
///
/// `call: &impl TypedCall<Left, Blocked>` declares also what calls tell while they run, and the values of their failures: structs that
/// derive `Variables`, or `()` for nothing. A client's `.watch(…)` hands each `Left` to a closure, and its error has `values()`, a
/// `Blocked`. It needs the feature `details` of the core, which Linux has always. On a board a function with
/// `call: &impl LongCall<Left, Blocked, State = Agv>` declares the same, and takes the call for a task.
///
/// A method of the client sends nothing: it returns a `Call`, which is sent by `.wait()` (Linux), `.await` or `.send()`.
///
/// | a function | has the state |
/// |---|---|
/// | `fn go_to(&mut self, …)` | while it runs, alone |
/// | `fn pos_info(&self)` | while it runs; on Linux beside others with `&self`, unless it has an `#[actuator]`, `#[stop]` or `#[reset]` |
/// | `fn stop()` | never, as an emergency service |
/// | `async fn fetch(state: &impl AsyncState<Self>, …)` | in `state.with(\|agv\| …).await?`, and not while it waits; on Linux, with the feature `async` |
///
/// On Linux a state with functions that take `&self` is `Sync`: what is not, as a serial port may be, goes into a `Mutex`, or the
/// functions take `&mut self`. Those that wait for the state have it in the order in which they began. A function that waits or sleeps with
/// `&mut self` keeps all others waiting, `&self` as well: it begins what takes long, and returns. One that has had the state for over a
/// second is warned about in the log.
///
/// An `async fn` becomes a `fn` that returns a future which is `Send`, so that any executor can run it; what implements the trait writes
/// `async fn`. Attributes, `call` and clients are as of any other function.
#[proc_macro_attribute]
pub fn interface(attribute: TokenStream, input: TokenStream) -> TokenStream {
    interface::expand(attribute.into(), input.into(), &quote!(::cara_core)).into()
}

/// The same, as `cara_std::interface`.
#[proc_macro_attribute]
pub fn interface_std(attribute: TokenStream, input: TokenStream) -> TokenStream {
    interface::expand(attribute.into(), input.into(), &quote!(::cara_std)).into()
}

/// The same, as `cara_embassy::interface`.
#[proc_macro_attribute]
pub fn interface_embassy(attribute: TokenStream, input: TokenStream) -> TokenStream {
    interface::expand(attribute.into(), input.into(), &quote!(::cara_embassy)).into()
}
