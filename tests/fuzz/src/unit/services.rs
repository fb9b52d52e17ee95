//! What the unit offers, and the motors behind it.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::LazyLock;

use cara_core::config::Priority;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::FunctionList;
use cara_core::services::lease::{Lease, Service};
use cara_core::services::stream::{Newest, Source, Value};
use cara_core::time::Duration;
use cara_sim::Boxed;

/// The leases of the two motors, in milliseconds.
pub(crate) const LEASES: [u64; 2] = [200, 60];
/// How many functions a unit offers at first.
pub(crate) const FUNCTIONS: usize = OFFERED.len();

/// The handler of a function.
pub(crate) struct Handler {
    pub(crate) motor: Option<usize>,
    lease: Option<Rc<Lease>>,
    /// It answers when the script says so, and not at once.
    pub(crate) is_slow: bool,
    pub(crate) values: Option<Values>,
}

impl Service for Handler {
    fn lease(&self) -> Option<&Lease> {
        self.lease.as_deref()
    }

    fn stream(&self) -> Option<&dyn Source> {
        self.values.as_ref().map(|values| values as &dyn Source)
    }
}

/// The newest value of a stream.
pub(crate) struct Values(pub(crate) RefCell<Newest<[u8; 8]>>);

impl Source for Values {
    fn version(&self) -> u32 {
        self.0.borrow().version()
    }

    fn newest(&self, look: &mut dyn FnMut(&Value<'_>)) {
        if let Some(value) = self.0.borrow().value() {
            look(&value);
        }
    }
}

/// A function: its text, its motor, whether it moves that, its attributes, and whether it answers late.
type Offered = (&'static str, Option<usize>, bool, Attributes, bool);

const NORMAL: Attributes = Attributes::NORMAL;
const STOP: Attributes = Attributes { stop: true, priority: Priority::Emergency, ..NORMAL };
const RESET: Attributes = Attributes { reset: true, ..NORMAL };
const OFFERED: [Offered; 11] = [
    ("go()", Some(0), true, NORMAL, false),
    ("turn()", Some(0), true, NORMAL, true),
    ("lift(x: int)", Some(1), true, Attributes { priority: Priority::High, ..NORMAL }, true),
    ("stop()", None, false, STOP, false),
    ("brake()", Some(0), false, STOP, true),
    ("reset()", None, false, RESET, true),
    ("free()", Some(0), false, RESET, false),
    ("now(x: int) -> (x: int)", None, false, NORMAL, false),
    ("held(x: int) -> (x: int) progress (x: int) fails (x: int)", None, false, NORMAL, true),
    ("texts(s: string[9], b: int[..3]) -> (f: float[2])", None, false, NORMAL, false),
    ("speed(x: int)", None, false, Attributes { stream: Some(5), ..NORMAL }, false),
];

static DEFINITIONS: LazyLock<Vec<Definition>> = LazyLock::new(|| {
    let parsed = OFFERED.iter().map(|(text, .., attributes, _)| match attributes.stream {
        Some(_) => Definition::stream(text),
        None => Definition::parse(text),
    });
    parsed.map(|definition| definition.expect("the texts are signatures")).collect()
});

/// One of these functions as it is added or replaced.
pub(crate) fn offered(index: usize, motors: &[Rc<Lease>]) -> (&'static Definition, Attributes, Handler) {
    let (_, motor, moves, attributes, is_slow) = OFFERED[index];
    let is_stream = attributes.stream.is_some();
    let length = motor.filter(|_| moves).and_then(|motor| LEASES.get(motor));
    let attributes = Attributes { lease: length.map(|length| Duration::from_millis(*length)), ..attributes };
    let lease = motor.and_then(|motor| motors.get(motor)).map(Rc::clone);
    let values = is_stream.then(|| Values(RefCell::new(Newest::new([0; 8]))));
    (&DEFINITIONS[index], attributes, Handler { motor, lease, is_slow, values })
}

/// The list of a unit that starts.
pub(crate) fn functions(motors: &[Rc<Lease>]) -> FunctionList<Boxed, Handler> {
    let entries = (0..FUNCTIONS + 1).map(|_| cara_core::distribution::function_list::Entry::empty()).collect();
    let mut list = FunctionList::new(entries, Boxed::slice(512));
    for index in 0..FUNCTIONS {
        let (definition, attributes, handler) = offered(index, motors);
        list.add_function(definition, attributes, handler).expect("the list has capacity");
    }
    list
}
