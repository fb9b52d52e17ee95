//! Structs in structs, lists and `Option`, as variables and in calls.

use cara_core::distribution::block::{self, SliceWriter};
use cara_core::distribution::function::Definition;
use cara_core::typed::{Mismatch, parameters_bytes};
use cara_core::{Error, Parameters, Variables};

#[derive(Variables, Clone, Copy, Debug, PartialEq)]
enum Side {
    Left,
    Right = 5,
}

#[derive(Variables, Clone, Debug, PartialEq)]
struct Place {
    x: f64,
    #[name = "y-m"]
    y: f32,
    side: Side,
}

#[derive(Variables, Clone, Debug, PartialEq)]
struct Action {
    #[size(16)]
    kind: String,
    lasts: f32,
}

#[derive(Variables, Clone, Debug, PartialEq)]
struct Node {
    id: u32,
    at: Option<Place>,
    #[size(3)]
    actions: Vec<Action>,
    #[size(4, 8)]
    tags: Vec<String>,
    #[size(8)]
    photo: Option<Vec<u8>>,
}

#[derive(Variables, Clone, Debug, PartialEq)]
struct Order {
    id: heapless::String<8>,
    start: Place,
    #[size(5)]
    nodes: Vec<Node>,
    speeds: heapless::Vec<f32, 3>,
    bends: heapless::Vec<[i16; 2], { 1 + 1 }>,
    #[size(2)]
    flags: Vec<bool>,
}

fn place(x: f64) -> Place {
    Place { x, y: -0.5, side: Side::Right }
}

fn order() -> Order {
    let lift = Action { kind: "lift".into(), lasts: 1.5 };
    let wait = Action { kind: "wait".into(), lasts: 0.0 };
    let tags = vec!["fast".into(), String::new()];
    Order {
        id: "o-7".try_into().unwrap(),
        start: place(1.0),
        nodes: vec![
            Node { id: 1, at: Some(place(2.0)), actions: vec![lift.clone(), wait], tags, photo: Some(vec![1, 2]) },
            Node { id: 2, at: None, actions: vec![lift], tags: vec![], photo: None },
        ],
        speeds: heapless::Vec::from_slice(&[0.5, 1.5]).unwrap(),
        bends: heapless::Vec::from_slice(&[[1, -2]]).unwrap(),
        flags: vec![true, false],
    }
}

/// The order's variables as a function's arguments.
fn taking(order: &Order) -> Definition {
    let mut parameters = Parameters::<4096>::sized();
    order.to_parameters(&mut parameters).unwrap();
    Definition::new("take").unwrap().arguments(&parameters).unwrap()
}

#[test]
fn structs_are_records_and_vectors_lists() {
    let place = "{x: float, y-m: float, side: int}";
    let action = "{kind: string[16], lasts: float}";
    let node = format!("{{id: int, at: {place}?, actions: {action}[..3], tags: string[8][..4], photo: bytes[8]?}}");
    let shown = format!(
        "take(id: string[8], start: {place}, nodes: {node}[..5], speeds: float[..3], bends: int[2][..2], flags: bool[..2])"
    );
    assert_eq!(taking(&order()).to_string(), shown);
    assert_eq!(taking(&order()).as_bytes(), Definition::parse(&shown).unwrap().as_bytes());
}

#[test]
fn an_order_goes_through_a_block() {
    for order in [order(), Order { nodes: vec![], flags: vec![], ..order() }] {
        let mut parameters = Parameters::<4096>::sized();
        order.to_parameters(&mut parameters).unwrap();
        let take = taking(&order);
        let mut bytes = vec![0; block::measure(take.signature().arguments(), &parameters).unwrap()];
        block::write(take.signature().arguments(), &parameters, &mut SliceWriter::new(&mut bytes));
        let mut got = Parameters::<4096>::sized();
        block::read_arguments(take.signature().arguments(), &bytes, &mut got).unwrap();
        assert_eq!(Order::from_parameters(&got), Ok(order.clone()));
        order.with_parameters(|own| assert_eq!(own, &*parameters)).unwrap();
    }
}

#[test]
fn the_fullest_order_has_room_and_no_more_is_needed() {
    let text = |length| "x".repeat(length);
    let action = Action { kind: text(16), lasts: 1.0 };
    let (tags, photo) = (vec![text(8); 4], Some(vec![7; 8]));
    let node = Node { id: 1, at: Some(place(1.0)), actions: vec![action; 3], tags, photo };
    let full = Order {
        id: "12345678".try_into().unwrap(),
        nodes: vec![node; 5],
        speeds: heapless::Vec::from_slice(&[1.0; 3]).unwrap(),
        bends: heapless::Vec::from_slice(&[[1; 2]; 2]).unwrap(),
        flags: vec![true; 2],
        ..order()
    };
    full.with_parameters(|_| ()).unwrap();
    // Again, with each list at its greatest length.
    const BYTES: usize = parameters_bytes(&[], Order::SPECS);
    let mut tight = Parameters::<BYTES>::sized();
    full.to_parameters(&mut tight).unwrap();
    assert_eq!(Order::from_parameters(&tight).as_ref(), Ok(&full));
}

#[test]
fn what_is_too_long_or_of_another_shape_is_an_error() {
    let mut parameters = Parameters::<4096>::sized();
    let long = Order { flags: vec![true; 3], ..order() };
    assert!(matches!(long.to_parameters(&mut parameters), Err(Error::WrongSize { expected: 2, found: 3, .. })));
    let mut kind = order();
    kind.nodes[0].actions[0].kind = "x".repeat(17);
    assert!(matches!(kind.to_parameters(&mut parameters), Err(Error::WrongSize { expected: 16, found: 17, .. })));
    // Variables of a peer with the same names and other types.
    let of = |text: &str| {
        let mut made = Parameters::<4096>::sized();
        order().to_parameters(&mut made).unwrap();
        let mut other = Parameters::<4096>::sized();
        for argument in Definition::parse(text).unwrap().signature().arguments() {
            other.add_spec(argument).unwrap();
        }
        other
    };
    #[derive(Variables, Debug, PartialEq)]
    struct Start {
        start: Place,
    }
    assert_eq!(Start::from_parameters(&of("f(start: {x: float, y-m: float, side: int})")), {
        // The peer's 0 is `Left`.
        Ok(Start { start: Place { x: 0.0, y: 0.0, side: Side::Left } })
    });
    assert_eq!(Start::from_parameters(&of("f(start: {x: float, y-m: float})")), Err(Error::UnknownVariable));
    assert_eq!(Start::from_parameters(&of("f(start: {x: float, z: float, side: int})")), Err(Error::UnknownVariable));
    assert_eq!(Start::from_parameters(&of("f(start: int)")), Err(Error::WrongType { index: 0 }));
    #[derive(Variables, Debug, PartialEq)]
    struct Speed {
        speed: Option<f64>,
    }
    let mut two = of("f(speed: float[..2])");
    assert_eq!(Speed::from_parameters(&two), Ok(Speed { speed: None }));
    two.set_list("speed", |list| list.push(1.5)).unwrap();
    assert_eq!(Speed::from_parameters(&two), Ok(Speed { speed: Some(1.5) }));
    two.set_list("speed", |list| list.push(1.5).and_then(|()| list.push(2.5))).unwrap();
    assert_eq!(Speed::from_parameters(&two), Err(Error::OutOfRange));
    #[derive(Variables, Debug, PartialEq)]
    struct Speeds {
        speed: heapless::Vec<f64, 1>,
    }
    assert_eq!(Speeds::from_parameters(&two), Err(Error::OutOfRange));
}

#[test]
fn a_mismatch_tells_the_way_to_the_difference() {
    let check = |ours: &str, theirs: &str| {
        let (ours, theirs) = (Definition::parse(ours).unwrap(), Definition::parse(theirs).unwrap());
        let found = Mismatch::check(ours.signature(), theirs.signature());
        found.map_err(|found| found.to_string().replace("the peer's f is of another version: its ", "")).err()
    };
    let reported = |text: &str| Some(format!("{text}: update one of the two"));
    for (ours, theirs, way) in [
        ("f(a: {x: int}[..2])", "f(a: {x: float}[..2])", "argument a[].x is float there and int here"),
        ("f(a: {x: int, y: int})", "f(a: {x: int})", "argument a.y is missing there and int here"),
        ("f(a: {x: int})", "f(a: {x: int, y: int})", "argument a.y is int there and missing here"),
        ("f(a: {x: int})", "f(a: {z: int})", "argument a.x is missing there and int here"),
        ("f(a: {x: {y: int[..2]}})", "f(a: {x: {y: bool[..2]}})", "argument a.x.y[] is bool there and int here"),
        ("f(a: int)", "f(a: int[..2])", "argument a is a list of at most 2 there and int here"),
        ("f() -> (a: {x: int})", "f() -> (a: int)", "result a is int there and a record of 1 here"),
        (
            "f() -> (a: {x: int[..2]})",
            "f() -> (a: {x: int[..3]})",
            "result a.x is a list of at most 3 there and a list of at most 2 here",
        ),
        (
            "f() -> (a: {x: string[2]})",
            "f() -> (a: {x: string[3]})",
            "result a.x is string[3] there and string[2] here",
        ),
    ] {
        assert_eq!(check(ours, theirs), reported(way), "{ours} and {theirs}");
    }
    assert_eq!(check("f(a: int[..3]) -> (b: int[..3])", "f(a: int[..2]) -> (b: int[..2])"), None);
    // A path that is too long ends at the last name that fits, even if a later one is shorter.
    let long = |kind: &str| format!("f({0}: {{a: {{b{0}: {{c: {kind}}}}}[..2]}})", "n".repeat(31));
    let way = format!("argument {}.a[] is bool there and int here", "n".repeat(31));
    assert_eq!(check(&long("int"), &long("bool")), reported(&way));
}

#[derive(Variables, Clone, Debug, PartialEq)]
enum Setting {
    #[name = "text"]
    #[size(8)]
    Text(String),
    Number(f64),
    Places(heapless::Vec<Place, 2>),
    #[size(2)]
    At(Option<Vec<Place>>),
}

#[derive(Variables, Clone, Debug, PartialEq)]
struct Settings {
    #[size(4)]
    all: Vec<Setting>,
    last: Option<Setting>,
}

#[test]
fn a_choice_is_a_record_with_one_field_present() {
    let place = "{x: float, y-m: float, side: int}";
    let choice = format!("{{text: string[8]?, Number: float?, Places: {place}[..2]?, At: {place}[..2]??}}");
    let places = heapless::Vec::from_slice(&[self::place(1.0)]).unwrap();
    let settings = Settings {
        all: vec![Setting::Text("high".into()), Setting::Number(0.5), Setting::Places(places), Setting::At(None)],
        last: Some(Setting::At(Some(vec![]))),
    };
    let mut parameters = Parameters::<4096>::sized();
    settings.to_parameters(&mut parameters).unwrap();
    let take = Definition::new("take").unwrap().arguments(&parameters).unwrap();
    assert_eq!(take.to_string(), format!("take(all: {choice}[..4], last: {choice}?)"));
    assert_eq!(Settings::from_parameters(&parameters), Ok(settings));
    for (count, read) in [(0, Err(Error::OutOfRange)), (1, Ok(())), (2, Err(Error::OutOfRange))] {
        let several = |list: &mut cara_core::distribution::parameters::ListWriter<'_>| {
            list.push_record(|record| {
                record.set_list("text", |list| if count > 0 { list.push("x") } else { Ok(()) })?;
                record.set_list("Number", |list| if count > 1 { list.push(1.0) } else { Ok(()) })?;
                record.set_list("Places", |_| Ok(()))?;
                record.set_list("At", |_| Ok(()))
            })
        };
        parameters.set_list("all", several).unwrap();
        assert_eq!(Settings::from_parameters(&parameters).map(|_| ()), read, "{count}");
    }
}
