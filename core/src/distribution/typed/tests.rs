#![allow(clippy::indexing_slicing, clippy::unwrap_used)]

use std::string::ToString;

use super::*;
use crate::distribution::function::Definition;
use crate::distribution::parameters::Parameters;

const fn spec(name: &'static str, kind: Type, size: u32) -> VariableSpec<'static> {
    VariableSpec::flat(name, kind, size)
}

const POSITION: VariableSpec<'static> = spec("position", Type::Int, 2);
const TEXT: VariableSpec<'static> = spec("text", Type::String, 200);
const DONE: VariableSpec<'static> = spec("done", Type::Bool, 1);

const ARGUMENTS: &[VariableSpec<'static>] = &[TEXT, POSITION];
const RESULTS: &[VariableSpec<'static>] = &[DONE, POSITION, spec("left", Type::Float, 1)];
#[cfg(feature = "details")]
const PROGRESS: &[VariableSpec<'static>] = &[spec("left", Type::Float, 1)];
#[cfg(feature = "details")]
const FAILS: &[VariableSpec<'static>] = &[spec("at", Type::Int, 2)];
const DECLARED: Declared<'static> = declared(ARGUMENTS, RESULTS);
const BYTES: usize = DECLARED.encoded_bytes("go-to");
const GO_TO: Result<Encoded<BYTES>, &str> = Encoded::new("go-to", DECLARED);

const fn declared<'a>(arguments: &'a [VariableSpec<'a>], results: &'a [VariableSpec<'a>]) -> Declared<'a> {
    Declared { arguments, results, progress: &[], fails: &[], help: "", units: &[] }
}

fn parsed(text: &str) -> Definition {
    Definition::parse(text).unwrap()
}

#[test]
fn what_is_encoded_when_compiling_is_what_is_parsed_at_run_time() {
    let text = "go-to(text: string[200], position: int[2]) -> (done: bool, position: int[2], left: float)";
    let encoded = GO_TO.unwrap();
    assert_eq!(encoded.signature().as_bytes(), parsed(text).as_bytes());
    assert_eq!(Signature::decode(encoded.signature().as_bytes()).unwrap().to_string(), text);
    let bytes = parameters_bytes(ARGUMENTS, RESULTS);
    assert_eq!(bytes as u32, encoded.signature().parameters_bytes());
    assert_eq!(declared(&[], &[]).encoded_bytes("f"), parsed("f()").as_bytes().len());
    assert_eq!(parameters_bytes(&[], &[]), 0);
}

#[cfg(feature = "details")]
#[test]
fn sections_are_encoded_when_compiling() {
    const REPORTED: Declared<'static> = Declared { progress: PROGRESS, fails: FAILS, ..DECLARED };
    const NO_PROGRESS: Declared<'static> = Declared { progress: &[], ..REPORTED };
    let text = "go-to(text: string[200], position: int[2]) -> (done: bool, position: int[2], left: float)";
    let reported = Encoded::<{ REPORTED.encoded_bytes("go-to") }>::new("go-to", REPORTED).unwrap();
    let whole = std::format!("{text} progress (left: float) fails (at: int[2])");
    assert_eq!(reported.signature().as_bytes(), parsed(&whole).as_bytes());
    let reported = Encoded::<{ NO_PROGRESS.encoded_bytes("go-to") }>::new("go-to", NO_PROGRESS).unwrap();
    assert_eq!(reported.signature().as_bytes(), parsed(&std::format!("{text} fails (at: int[2])")).as_bytes());
}

#[cfg(feature = "details")]
#[test]
fn a_peer_may_leave_sections_out_and_has_them_alike() {
    let ours = parsed("go() progress (left: float, at: int[2]) fails (at: int[2])");
    let differs = |theirs: &str| {
        let theirs = parsed(theirs);
        Mismatch::check(ours.signature(), theirs.signature()).err().map(|mismatch| mismatch.to_string())
    };
    assert_eq!(differs("go()"), None);
    assert_eq!(differs("go() progress (at: int[2], left: float, more: int)"), None);
    let reported = differs("go() progress (at: int[2], left: int)").unwrap();
    assert!(reported.contains("its progress left is int there and float here"), "{reported}");
    let reported = differs("go() fails (at: int[3])").unwrap();
    assert!(reported.contains("its failure's at is int[3] there and int[2] here"), "{reported}");
    let reported = differs("go() progress (left: float)").unwrap();
    assert!(reported.contains("its progress at is missing there"), "{reported}");
}

#[test]
fn places_are_those_of_a_view_made_from_the_signature() {
    let encoded = GO_TO.unwrap();
    let mut view = Parameters::<512>::sized();
    view.add_int("gone", 1).unwrap();
    view.lay_out(encoded.signature()).unwrap();
    let names: std::vec::Vec<&str> = view.iter().map(|variable| variable.name).collect();
    assert_eq!(names, ["text", "position", "done", "left"]);
    let places = places_of_results(ARGUMENTS, RESULTS);
    for (index, result) in RESULTS.iter().enumerate() {
        assert_eq!(names[place(&places, index)], result.name);
    }
    assert_eq!(place(&places, 99), usize::MAX);
    assert_eq!(view.value_of(4).err(), Some(Error::UnknownVariable));
    assert_eq!(view.target_of(4).map(|_| ()), Err(Error::UnknownVariable));
}

#[test]
fn every_rule_of_a_definition_holds_when_compiling() {
    let refused = |name: &str, arguments: &[VariableSpec<'_>], results: &[VariableSpec<'_>]| {
        Encoded::<BYTES>::new(name, declared(arguments, results)).err().unwrap_or_default()
    };
    assert_eq!(refused("go-to", ARGUMENTS, RESULTS), "");
    assert!(refused("go to", ARGUMENTS, RESULTS).contains("a function's name"));
    assert!(refused("", ARGUMENTS, RESULTS).contains("a function's name"));
    let long = "a".repeat(33);
    assert!(refused(&long, ARGUMENTS, RESULTS).contains("a function's name"));
    assert!(refused("f", &[VariableSpec { name: &long, ..TEXT }], &[]).contains("an argument's name"));
    assert!(refused("f", &[], &[spec("a b", Type::Int, 1)]).contains("a result's name"));
    assert!(refused("f", &[TEXT, POSITION, TEXT], &[]).contains("two arguments"));
    assert!(refused("f", &[], &[DONE, DONE]).contains("two results"));
    assert!(refused("f", &[POSITION], &[spec("position", Type::Float, 2)]).contains("one variable"));
    assert!(refused("f", &[POSITION], &[spec("position", Type::Int, 3)]).contains("one variable"));
    let names: std::vec::Vec<_> = (0..17).map(|index| std::format!("v{index}")).collect();
    let many: std::vec::Vec<_> = names.iter().map(|name| VariableSpec { name, ..DONE }).collect();
    assert!(refused("f", &many, &[]).contains("at most 16"));
    assert!(refused("f", &many[..16], &many[16..]).contains("at most 16"));
    assert_eq!(refused("f", &many[..16], &many[..16]), "the signature has another length");
    let names: std::vec::Vec<_> = (0..16).map(|index| std::format!("{index:032}")).collect();
    let long: std::vec::Vec<_> = names.iter().map(|name| VariableSpec { name, ..DONE }).collect();
    assert!(refused("f", &long, &long).contains("`SIGNATURE_BYTES`"));
    assert_eq!(refused("f", &[], &[]), "the signature has another length");
}

#[test]
fn every_rule_of_sections_holds_when_compiling() {
    let refused = |progress: &[VariableSpec<'_>], fails: &[VariableSpec<'_>]| {
        let declared = Declared { arguments: &[], results: &[], progress, fails, help: "", units: &[] };
        Encoded::<12>::new("f", declared).err().unwrap_or_default()
    };
    assert!(refused(&[VariableSpec { name: "a b", ..DONE }], &[]).contains("has a name of 1 to 32"));
    assert!(refused(&[], &[VariableSpec { name: "", ..DONE }]).contains("has a name of 1 to 32"));
    assert!(refused(&[DONE, DONE], &[]).contains("two values"));
    assert!(refused(&[], &[POSITION, POSITION]).contains("two values"));
    assert_eq!(refused(&[], &[spec("text", Type::String, 252)]), "the signature has another length");
    assert!(refused(&[], &[spec("text", Type::String, 253)]).contains("FAILURE_VALUES_BYTES"));
    let names: std::vec::Vec<_> = (0..17).map(|number| std::format!("n{number}")).collect();
    let many: std::vec::Vec<_> = names.iter().map(|name| VariableSpec { name, ..DONE }).collect();
    assert!(refused(&many, &[]).contains("at most 16"));
    assert!(refused(&[], &many).contains("at most 16"));
}

#[test]
fn a_mismatch_names_function_variable_and_both_types() {
    let check = |ours: &str, theirs: &str| {
        let (ours, theirs) = (parsed(ours), parsed(theirs));
        Mismatch::check(ours.signature(), theirs.signature()).map_err(|found| found.to_string()).err()
    };
    assert_eq!(check("f(a: int) -> (b: float)", "f(a: int) -> (b: float)"), None);
    assert_eq!(
        check("f(a: int)", "f(a: float[2])").unwrap(),
        "the peer's f is of another version: its argument a is float[2] there and int here: update one of the two"
    );
    assert_eq!(
        check("f()", "f(a: bool)").unwrap(),
        "the peer's f is of another version: its argument a is bool there and missing here: update one of the two"
    );
    assert_eq!(
        check("f() -> (b: string[9])", "f()").unwrap(),
        "the peer's f is of another version: its result b is missing there and string[9] here: update one of the two"
    );
    assert!(check("f() -> (b: int[2])", "f() -> (b: int[3])").is_some());
    assert!(check("f() -> (b: string[8])", "f() -> (b: string[9])").is_some(), "it would not fit");
    // More than needed, and other lengths of text, are compatible.
    assert_eq!(check("f(a: int, more: int)", "f(a: int)"), None);
    assert_eq!(check("f() -> (b: int)", "f() -> (more: int, b: int)"), None);
    assert_eq!(check("f(a: string[9])", "f(a: string[8])"), None);
    assert_eq!(check("f() -> (b: bytes[9])", "f() -> (b: bytes[8])"), None);
}

/// Two fields and a vector of bytes.
#[derive(Debug, PartialEq)]
struct Pose {
    at: [i64; 2],
    photo: heapless::Vec<u8, 4>,
}

impl Variables for Pose {
    const SPECS: &'static [VariableSpec<'static>] = &[
        spec("at", <[i64; 2] as Field>::KIND, <[i64; 2] as Field>::SIZE),
        spec("photo", heapless::Vec::<u8, 4>::KIND, heapless::Vec::<u8, 4>::SIZE),
    ];

    fn read_places(parameters: &ParametersView, places: &[u8]) -> Result<Self, Error> {
        let at = parameters.value_of(place(places, 0)).and_then(Field::from_field)?;
        Ok(Self { at, photo: parameters.value_of(place(places, 1)).and_then(Field::from_field)? })
    }

    fn write_places(&self, parameters: &mut ParametersView, places: &[u8]) -> Result<(), Error> {
        parameters.slot_of(place(places, 0)).and_then(|slot| self.at.to_field(slot))?;
        parameters.slot_of(place(places, 1)).and_then(|slot| self.photo.to_field(slot))
    }

    fn with_parameters<R>(&self, look: impl FnOnce(&ParametersView) -> R) -> Result<R, Error> {
        let mut parameters = Parameters::<64>::sized();
        self.to_parameters(&mut parameters).map(|()| look(&parameters))
    }
}

#[test]
fn a_struct_is_found_by_its_names_in_any_parameters() {
    let pose = Pose { at: [1, -2], photo: heapless::Vec::from_slice(&[9, 8]).unwrap() };
    let mut parameters = Parameters::new();
    parameters.add_bytes("photo", 4).unwrap();
    parameters.add_bool("other", 1).unwrap();
    assert_eq!(Pose::from_parameters(&parameters), Err(Error::UnknownVariable));
    pose.to_parameters(&mut parameters).unwrap();
    assert_eq!(parameters.len(), 3);
    assert_eq!(Pose::from_parameters(&parameters).as_ref(), Ok(&pose));
    assert_eq!(parameters.variable::<[i64; 2]>("at"), Ok([1, -2]));
    let text = heapless::String::<3>::try_from("abc").unwrap();
    parameters.add_string("text", 5).unwrap();
    text.to_field(parameters.slot_of(3).unwrap()).unwrap();
    assert_eq!(heapless::String::<3>::from_field(parameters.value_of(3).unwrap()), Ok(text));
    assert_eq!(heapless::String::<2>::from_field(parameters.value_of(3).unwrap()), Err(Error::OutOfRange));
    assert_eq!(argument::<u8>(&parameters, 2), Err(ServiceError::Failed(BAD_ARGUMENT)), "a bool");
    assert_eq!(borrowed::<&str>(&parameters, 3), Ok("abc"));
}
