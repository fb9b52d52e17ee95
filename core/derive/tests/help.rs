//! Help and units of a trait and its structs.

use cara_core::distribution::function::Definition;
use cara_core::typed::{Mismatch, TypedCall, stream_of};
use cara_core::{ServiceError, Variables, interface};

/// What is left to do.
#[derive(Variables)]
struct Left {
    #[unit = "m"]
    left: f64,
    share: f32,
}

/// Where the fork is,
/// above the floor.
///
/// It is read four times a second.
#[derive(Variables)]
struct Height {
    #[unit = "m"]
    height: f64,
    #[unit = "kg"]
    #[name = "load-0"]
    load: f64,
}

#[interface]
trait Fork {
    /// Lifts the fork while its caller wants it.
    ///
    /// It stops at the limits.
    #[actuator(motor)]
    #[lease(ms = 400)]
    #[returns(#[unit = "m"] reached, moved)]
    fn lift_to(
        &mut self,
        call: &impl TypedCall<Left, ()>,
        #[unit = "m"] height: f64,
        speed: f64,
    ) -> Result<(f64, bool), ServiceError>;

    fn height(&mut self) -> Height;

    #[help = "Takes what lies there."]
    fn take(&mut self, #[variables] from: Height);

    /// Tells at some length what can be said in far fewer words, so that nobody reads on who wants to know what it does, and that in a sentence which
    /// goes on and on beyond what there is room for
    fn explain(&mut self);

    fn nothing(&mut self);
}

type Functions = __ForkFunctions;

#[test]
fn a_trait_tells_help_and_units() {
    let lift = Functions::SIGNATURE_lift_to;
    assert_eq!(lift.help(), "Lifts the fork while its caller wants it.");
    assert_eq!(lift.units().collect::<Vec<_>>(), [("height", "m"), ("reached", "m"), ("left", "m")]);
    assert_eq!((lift.unit_of("left"), lift.unit_of("speed"), lift.unit_of("share")), (Some("m"), None, None));
    let of_struct = vec![("height", "m"), ("load-0", "kg")];
    assert_eq!(
        (Functions::SIGNATURE_height.help(), Functions::SIGNATURE_height.units().collect()),
        ("", of_struct.clone())
    );
    assert_eq!(Functions::SIGNATURE_take.help(), "Takes what lies there.");
    assert_eq!(Functions::SIGNATURE_take.units().collect::<Vec<_>>(), of_struct);
    let cut = Functions::SIGNATURE_explain.help();
    assert!(cut.ends_with(" goes on and…") && cut.len() <= 160, "{cut}");
    assert_eq!(Functions::SIGNATURE_nothing.as_bytes(), Definition::new("nothing").unwrap().as_bytes());
}

#[test]
fn they_are_what_the_dynamic_form_writes() {
    let text =
        "lift_to(height: float, speed: float) -> (reached: float, moved: bool) progress (left: float, share: float)";
    let lift = Definition::parse(text).unwrap().help("Lifts the fork while its caller wants it.").unwrap();
    let units = ["height", "reached", "left"].into_iter();
    let lift = units.fold(lift, |lift, variable| lift.unit(variable, "m").unwrap());
    assert_eq!(lift.as_bytes(), Functions::SIGNATURE_lift_to.as_bytes());
    let plain = Definition::parse(text).unwrap();
    assert_ne!(plain.as_bytes(), lift.as_bytes());
    assert_eq!(Mismatch::check(plain.signature(), lift.signature()), Ok(()), "people's words are no version");
}

#[test]
fn a_stream_has_the_help_of_its_struct() {
    let height = stream_of::<Height>("height").unwrap();
    assert_eq!(height.signature().help(), "Where the fork is, above the floor.");
    assert_eq!(height.signature().unit_of("load-0"), Some("kg"));
}
