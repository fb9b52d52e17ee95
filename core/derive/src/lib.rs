//! The macros of CARA's typed services: `#[derive(Variables)]` for structs and enums, and `#[interface]`, which generates a
//! server and a client from a trait.
//!
//! Use them as re-exported by `cara_core`, `cara_std` or `cara_embassy` (feature `derive`): the three forms of each macro differ
//! only in the crate that the generated code refers to.

mod attributes;
mod calling;
mod client;
mod interface;
mod kind;
mod server;
mod variables;

use proc_macro::TokenStream;
use quote::quote;

/// As `cara_core::Variables`: each field of a struct is a variable with its name; an enum without fields is one integer.
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
/// With the feature `nested` of the core, which is always on for Linux, a field whose type is such a struct is a record, `Vec<T>`
/// and `heapless::Vec<T, N>` are lists, and `Option<T>` is a list of at most one element. An enum whose variants have one value each
/// is a choice: a record with an optional field for each variant, exactly one of which is present; any other number of them is refused
/// as out of range. `Setting` is `{text: string[64]?, number: float?}`, in JSON `{"number": 1.5}`.
///
/// ```
/// # use cara_core::Variables;
/// #[derive(Variables)]
/// enum Setting {
///     #[name = "text"]
///     #[size(64)]
///     Text(String),
///     #[name = "number"]
///     Number(f64),
/// }
/// ```
///
/// | attribute of a field or of a choice's variant | means |
/// |---|---|
/// | `#[size(200)]` | the most bytes of a `String` or `Vec<u8>`, or elements of a `Vec<T>`; `#[size(50, 32)]` for a `Vec<String>` |
/// | `#[name = "x-1"]` | the variable's name, if it is not the field's |
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

/// As `cara_core::interface`: generates `DriveServer` and `DriveClient` from a trait `Drive`.
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
/// Functions that move something have an actuator and a lease. This one also declares progress and the values of its failures:
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
/// | `#[priority(high)]` | the default class of calls: `emergency`, `high`, `normal`, `low` |
/// | `#[actuator(drive)]` | what it moves, stops or resets: a field of the server |
/// | `#[lease(ms = 400)]` | how long motion continues after the caller's last renewal |
/// | `#[stop]`, `#[reset]` | it stops or resets its actuator or, without one, all |
/// | `#[idempotent]` | callers may repeat it |
/// | `#[help = "…"]` | one line of help; by default the first paragraph of its documentation. Every peer that may see the function can read it: `#[help = ""]` publishes none |
/// | `#[name = "go-to"]` | its name, if it is not the method's |
///
/// Arguments have `#[size(200)]`, `#[name = "…"]` and `#[unit = "m"]` as fields do; so have names of results: `#[returns(#[unit =
/// "%"] charge)]`. A single argument may be `#[variables] order: Order`: then the fields of `Order` are the arguments. `call:
/// &impl AnyCall` describes the call; a trait declares types in its bounds that differ between ports (`type Order;`).
///
/// `call: &impl TypedCall<Left, Blocked>` also declares the progress of calls and the values of failures: structs that derive
/// `Variables`, or `()` for none. A client's `.watch(…)` passes each `Left` to a closure, and `values()` of its error is a
/// `Blocked`. This needs the feature `details` of the core, which is always on for Linux. On a board, `call: &impl LongCall<Left,
/// Blocked, State = Agv>` declares the same, for a task that takes the call.
///
/// A method of the client sends nothing: it returns a `Call`, which `.wait()` (Linux), `.await` or `.send()` sends.
///
/// | a function | has the state |
/// |---|---|
/// | `fn go_to(&mut self, …)` | while it runs, alone |
/// | `fn pos_info(&self)` | while it runs; on Linux beside others with `&self`, unless it has an `#[actuator]`, `#[stop]` or `#[reset]` |
/// | `fn stop()` | never, as an emergency service |
/// | `async fn fetch(state: &impl AsyncState<Self>, …)` | in `state.with(\|agv\| …).await?`, and not while it waits; on Linux, with the feature `async` |
///
/// On Linux the state must be `Sync` if functions take `&self`: put what is not, such as a serial port, into a `Mutex`, or take
/// `&mut self`. Functions that wait for the state get it in the order in which they began. A function with `&mut self` that
/// blocks keeps all others waiting, including those with `&self`: let it start what takes long, and return. One that has held the
/// state for over a second is logged as a warning.
///
/// An `async fn` becomes a `fn` that returns a `Send` future, so that any executor can run it; implementations still write `async
/// fn`. Attributes, `call` and clients are the same as for other functions.
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
