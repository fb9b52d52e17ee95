//! The table compared with a simple model.

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::super::known::NodeState;
use super::super::table::Table;
use super::super::timetable::Task;
use super::*;

/// Capacity at first and after growing. Not above the capacity for unjoined nodes.
const CAPACITY: usize = 5;
const GROWN: usize = 8;

fn identity(which: u8) -> Identity {
    let role = if which.is_multiple_of(3) { Role::MUnit } else { Role::SUnit };
    Identity::new(["x", "y"][usize::from(which % 2)], u32::from(which / 2), role).unwrap()
}

#[derive(Clone, Debug)]
enum Step {
    Meet(u8),
    Join(u8),
    Leave(u8),
    Schedule(u8, u64),
    Cancel(u8),
    Pop(u64),
    Grow,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        (0u8..16).prop_map(Step::Meet),
        (0u8..16).prop_map(Step::Join),
        (0u8..16).prop_map(Step::Leave),
        (0u8..16, 0u64..100).prop_map(|(who, at)| Step::Schedule(who, at)),
        (0u8..16).prop_map(Step::Cancel),
        (0u64..100).prop_map(Step::Pop),
        Just(Step::Grow),
    ]
}

/// The model of a node: whether it joined, when it left, its index, and what is due when.
#[derive(Clone, Debug)]
struct Entry {
    joined: bool,
    rested: usize,
    index: Option<u16>,
    due: Option<u64>,
    /// When it was heard of, if it has not joined.
    unjoined: Option<usize>,
}

type Model = BTreeMap<u8, Entry>;

fn meet(model: &mut Model, capacity: usize, clock: usize, who: u8, joins: bool) -> bool {
    if model.contains_key(&who) {
        return true;
    }
    if model.len() == capacity {
        let away = model.iter().filter(|(_, entry)| !entry.joined);
        let key = |entry: &Entry| (entry.unjoined.is_none(), entry.unjoined.unwrap_or(entry.rested));
        let Some(oldest) = away.min_by_key(|(_, entry)| key(entry)).map(|(who, _)| *who) else { return false };
        model.remove(&oldest);
    }
    model.insert(
        who,
        Entry { joined: false, rested: clock, index: None, due: None, unjoined: (!joins).then_some(clock) },
    );
    true
}

fn lowest_free(model: &Model, role: Role) -> u16 {
    let taken = |index| model.iter().any(|(who, entry)| identity(*who).role() == role && entry.index == Some(index));
    (0..).find(|index| !taken(*index)).unwrap()
}

fn check(table: &Table<InMemory>, model: &Model) {
    for who in 0..16 {
        let found = table.find(&identity(who)).and_then(|place| table.node(place));
        let entry = model.get(&who);
        assert_eq!(found.map(|known| known.identity.clone()), entry.map(|_| identity(who)));
        assert_eq!(found.map(Known::is_joined), entry.map(|entry| entry.joined));
        assert_eq!(found.and_then(Known::index), entry.and_then(|entry| entry.index));
        if let Some(index) = entry.and_then(|entry| entry.index) {
            let same = table.at_index(identity(who).role(), index).map(|known| known.identity.clone());
            assert_eq!(same, Some(identity(who)));
        }
    }
    for role in [Role::MUnit, Role::SUnit] {
        let joined = model.iter().filter(|(who, entry)| entry.joined && identity(**who).role() == role).count();
        assert_eq!(usize::from(table.joined_as(role)), joined);
    }
    let next = model.values().filter_map(|entry| entry.due).min();
    assert_eq!(table.next_due(), next.map_or(Instant::FAR_FUTURE, Instant::from_micros));
}

proptest! {
    #[test]
    fn the_table_is_what_its_model_is(steps in prop::collection::vec(step(), 1..120)) {
        let mut table: Table<InMemory> = Table::new(slice(CAPACITY), slice(CAPACITY), slice(4));
        let (mut model, mut capacity) = (Model::new(), CAPACITY);
        for (clock, step) in steps.into_iter().enumerate() {
            match step {
                Step::Meet(who) => {
                    let place = table.hear_of(&identity(who), address(1, 1), Epoch(1));
                    prop_assert_eq!(place.is_some(), meet(&mut model, capacity, clock, who, false));
                }
                Step::Join(who) => {
                    let place = table.place_of(&identity(who), address(1, 1), Epoch(1));
                    prop_assert_eq!(place.is_some(), meet(&mut model, capacity, clock, who, true));
                    let Some((place, _)) = place else { continue };
                    table.set_state(place, NodeState::Joined(LinkId(u16::from(who))));
                    table.keep_index(place);
                    let free = lowest_free(&model, identity(who).role());
                    let entry = model.get_mut(&who).unwrap();
                    entry.joined = true;
                    entry.unjoined = None;
                    entry.index.get_or_insert(free);
                }
                Step::Leave(who) => {
                    let Some(place) = table.find(&identity(who)) else { continue };
                    table.set_state(place, NodeState::Away);
                    let entry = model.get_mut(&who).unwrap();
                    if core::mem::take(&mut entry.joined) {
                        entry.rested = clock;
                    }
                }
                Step::Schedule(who, at) => {
                    let Some(place) = table.find(&identity(who)) else { continue };
                    table.schedule(place, Instant::from_micros(at), Task::Dial);
                    model.get_mut(&who).unwrap().due = Some(at);
                }
                Step::Cancel(who) => {
                    let Some(place) = table.find(&identity(who)) else { continue };
                    table.cancel(place);
                    model.get_mut(&who).unwrap().due = None;
                }
                Step::Grow => {
                    // Shorter slices are ignored.
                    table.grow(slice(CAPACITY - 1), slice(GROWN), slice(4));
                    table.grow(slice(GROWN), slice(GROWN), slice(4));
                    capacity = GROWN;
                }
                Step::Pop(now) => {
                    let earliest = model.values().filter_map(|entry| entry.due).min().filter(|at| *at <= now);
                    let popped = table.pop_due(Instant::from_micros(now)).map(|(place, _)| place);
                    prop_assert_eq!(popped.is_some(), earliest.is_some());
                    let Some(place) = popped else { continue };
                    let who = (0..16).find(|who| table.find(&identity(*who)) == Some(place)).unwrap();
                    prop_assert_eq!(model.get_mut(&who).unwrap().due.take(), earliest);
                }
            }
            check(&table, &model);
        }
    }
}
