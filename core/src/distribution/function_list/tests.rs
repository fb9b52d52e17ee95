#![allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::arithmetic_side_effects
)]

use std::collections::BTreeMap;
use std::string::String;
use std::vec::Vec;
use std::{format, vec};

use proptest::prelude::*;

use super::*;
use crate::distribution::function::Definition;
use crate::storage::Boxed;

type Mine = FunctionList<Boxed, u32>;
type Theirs = TheirFunctionList<Boxed>;

fn mine(functions: usize, bytes: usize) -> Mine {
    Mine::new((0..functions).map(|_| Entry::empty()).collect(), vec![0; bytes].into())
}

fn theirs(functions: usize, bytes: usize) -> Theirs {
    Theirs::new((0..functions).map(|_| Entry::empty()).collect(), vec![0; bytes].into())
}

fn parse(text: &str) -> Definition {
    Definition::parse(text).unwrap()
}

fn usual() -> Attributes {
    Attributes::default()
}

#[test]
fn adding_invalidates_nothing_and_removing_only_its_slot() {
    let mut list = mine(3, 100);
    let a = list.add_function(&parse("a()"), usual(), 1).unwrap();
    let b = list.add_function(&parse("b(x: int)"), usual(), 2).unwrap();
    let [of_a, of_b] = [a, b].map(|slot| list.function(slot).unwrap().generation);
    list.add_function(&parse("c()"), usual(), 3).unwrap();
    assert_eq!(list.lookup(a, of_a).unwrap().name(), "a");
    assert_eq!(list.remove("a"), Ok((a, 1)));
    assert_eq!(list.lookup(a, of_a).err(), Some(Error::StaleFunction));
    assert_eq!(list.lookup(b, of_b).map(|function| *function.handler), Ok(2));
    let d = list.add_function(&parse("d()"), usual(), 4).unwrap();
    assert_eq!(d, a);
    assert_eq!(list.lookup(d, of_a).err(), Some(Error::StaleFunction));
    assert_eq!(list.lookup(d, list.generation(d).unwrap()).unwrap().name(), "d");
    assert_eq!(list.lookup(Slot(3), of_a).err(), Some(Error::UnknownFunction));
    assert_eq!(mine(1, 10).lookup(Slot(0), Generation(0)).err(), Some(Error::UnknownFunction));
}

#[test]
fn replacing_makes_old_requests_stale() {
    let mut list = mine(2, 30);
    let slot = list.add_function(&parse("f(x: int)"), usual(), 1).unwrap();
    list.add_function(&parse("g()"), usual(), 2).unwrap();
    let old = list.function(slot).unwrap().generation;
    let too_long = parse("f(x: int, yyyyyyyyyyyyyyyyy: int)");
    assert_eq!(list.replace(&too_long, usual(), 9), Err(Error::Full(Limit::SignatureBytes)));
    assert_eq!(list.lookup(slot, old).map(|function| *function.handler), Ok(1));
    assert_eq!(list.replace(&parse("f(x: int, y: bool)"), usual(), 3), Ok(slot));
    assert_eq!(list.lookup(slot, old).err(), Some(Error::StaleFunction));
    assert_eq!(format!("{}", list.show_functions()), "f(x: int, y: bool)\ng()\n");
    assert_eq!(list.replace(&parse("h()"), usual(), 5), Err(Error::UnknownFunction));
}

#[test]
fn a_peers_list_grows_with_its_functions_and_up_to_what_it_may_have() {
    let mut list = theirs(1, 8);
    let notify = |list: &mut Theirs, slot: u16, text: &str| {
        list.insert(Slot(slot), Generation(7), usual(), parse(text).as_bytes())
    };
    notify(&mut list, 0, "a()").unwrap();
    assert_eq!(notify(&mut list, 1, "b()").err(), Some(Error::Full(Limit::Functions)), "it may not grow");
    list.let_grow(4, 60);
    notify(&mut list, 1, "b(position: int[2])").unwrap();
    assert_eq!(list.table.entries.len(), 2, "half as many again, or those that are needed");
    notify(&mut list, 9, "c()").unwrap();
    assert_eq!(format!("{}", list.show_functions()), "a()\nb(position: int[2])\nc()\n");
    assert!(list.iter().all(|function| function.generation == Generation(7)));
    let long = "d(wwwwwwwwwwwwwwwwwwwwwwwwwwwwww: int, xxxxxxxxxxxxxxxxxxxxxxxxxxxxxx: int)";
    assert_eq!(notify(&mut list, 2, long).err(), Some(Error::Full(Limit::SignatureBytes)));
    notify(&mut list, 2, "d()").unwrap();
    assert_eq!(notify(&mut list, 3, "e()").err(), Some(Error::Full(Limit::Functions)));
    assert_eq!((list.table.entries.len(), list.table.bytes.len()), (4, 60));
    assert!(list.remove(Slot(0)));
    notify(&mut list, 3, "e()").unwrap();
    assert_eq!((list.table.entries.len(), list.len(), list.skipped()), (4, 4, 3));
    list.clear();
    assert!(list.is_empty());
}

#[test]
fn full_names_the_limit_and_changes_nothing() {
    let mut list = mine(2, 9);
    list.add_function(&parse("a()"), usual(), 1).unwrap();
    assert_eq!(list.add_function(&parse("a()"), usual(), 2), Err(Error::NameTaken));
    assert_eq!(list.add_function(&parse("long()"), usual(), 2), Err(Error::Full(Limit::SignatureBytes)));
    list.add_function(&parse("b()"), usual(), 2).unwrap();
    assert_eq!(list.add_function(&parse("c()"), usual(), 3), Err(Error::Full(Limit::Functions)));
    assert_eq!(list.remove("c"), Err(Error::UnknownFunction));
    assert_eq!(format!("{}", list.show_functions()), "a()\nb()\n");
}

#[test]
fn a_name_is_not_found_by_its_beginning() {
    let mut list = mine(2, 99);
    list.add_function(&parse("abc()"), usual(), 1).unwrap();
    assert_eq!([list.find("ab"), list.find("abcd"), list.find("")], [None; 3]);
    assert_eq!(list.find("abc"), Some(Slot(0)));
}

#[test]
fn what_a_small_list_cannot_keep_is_counted() {
    let mut list = theirs(2, 99);
    for (slot, name) in ["a()", "b()", "c()", "d()"].into_iter().enumerate() {
        let reported = list.insert(Slot(slot as u16 + 100), Generation(7), usual(), parse(name).as_bytes());
        assert_eq!(reported, if slot < 2 { Ok(()) } else { Err(Error::Full(Limit::Functions)) });
    }
    assert_eq!((list.len(), list.skipped()), (2, 2));
    assert_eq!(list.find("b"), Some(Slot(101)));
    assert_eq!(list.function(Slot(101)).unwrap().generation, Generation(7));
    assert_eq!(list.insert(Slot(1), Generation(0), usual(), b"nonsense"), Err(Error::Malformed));
    assert!(list.remove(Slot(101)) && !list.remove(Slot(101)));
    list.clear();
    assert_eq!((list.len(), list.skipped()), (0, 0));
}

#[test]
fn news_of_a_slot_or_name_replaces_the_old() {
    let mut list = theirs(3, 99);
    list.insert(Slot(0), Generation(0), usual(), parse("f()").as_bytes()).unwrap();
    list.insert(Slot(1), Generation(0), usual(), parse("g()").as_bytes()).unwrap();
    list.insert(Slot(0), Generation(1), usual(), parse("f(x: int)").as_bytes()).unwrap();
    assert_eq!(list.named("f").map(|function| (function.slot, function.generation)), Some((Slot(0), Generation(1))));
    // The peer has moved a function; its removal from the old slot follows.
    list.insert(Slot(2), Generation(0), usual(), parse("g()").as_bytes()).unwrap();
    assert_eq!(list.find("g"), Some(Slot(2)));
    assert!(!list.remove(Slot(1)));
    assert_eq!(list.len(), 2);
}

/// One of a few functions whose signatures have different lengths.
fn sample(name: u8, arguments: u8) -> Definition {
    let list: Vec<_> = (0..arguments).map(|index| format!("a{index}: int[{name}]")).collect();
    parse(&format!("f{name}({})", list.join(", ")))
}

#[derive(Clone, Debug)]
enum Step {
    Add(u8, u8, u32),
    Replace(u8, u8, u32),
    Remove(u8),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        (0..12_u8, 0..4_u8, any::<u32>()).prop_map(|(name, arguments, handler)| Step::Add(name, arguments, handler)),
        (0..12_u8, 0..4_u8, any::<u32>())
            .prop_map(|(name, arguments, handler)| Step::Replace(name, arguments, handler)),
        (0..12_u8).prop_map(Step::Remove),
    ]
}

proptest! {
    #[test]
    fn own_list_behaves_like_a_map(steps in prop::collection::vec(step(), 0..60)) {
        let (functions, bytes) = (8, 120);
        let mut list = mine(functions, bytes);
        let mut model = BTreeMap::<u8, (Definition, u32, Slot, Generation)>::new();
        for step in steps {
            let used: usize = model.values().map(|function| function.0.as_bytes().len()).sum();
            match step {
                Step::Add(name, arguments, handler) => {
                    let new = sample(name, arguments);
                    let expected = if model.contains_key(&name) {
                        Some(Error::NameTaken)
                    } else if model.len() == functions {
                        Some(Error::Full(Limit::Functions))
                    } else if used + new.as_bytes().len() > bytes {
                        Some(Error::Full(Limit::SignatureBytes))
                    } else {
                        None
                    };
                    let added = list.add_function(&new, usual(), handler);
                    prop_assert_eq!(added.err(), expected);
                    if let Ok(slot) = added {
                        model.insert(name, (new, handler, slot, list.generation(slot).unwrap()));
                    }
                }
                Step::Replace(name, arguments, handler) => {
                    let new = sample(name, arguments);
                    let replaced = list.replace(&new, usual(), handler);
                    match model.get_mut(&name) {
                        None => prop_assert_eq!(replaced, Err(Error::UnknownFunction)),
                        Some(old) if used - old.0.as_bytes().len() + new.as_bytes().len() > bytes => {
                            prop_assert_eq!(replaced, Err(Error::Full(Limit::SignatureBytes)));
                        }
                        Some(old) => {
                            prop_assert_eq!(replaced, Ok(old.2));
                            prop_assert_eq!(list.lookup(old.2, old.3).err(), Some(Error::StaleFunction));
                            *old = (new, handler, old.2, list.generation(old.2).unwrap());
                        }
                    }
                }
                Step::Remove(name) => match model.remove(&name) {
                    None => prop_assert_eq!(list.remove(&format!("f{name}")), Err(Error::UnknownFunction)),
                    Some((_, handler, slot, generation)) => {
                        prop_assert_eq!(list.remove(&format!("f{name}")), Ok((slot, handler)));
                        prop_assert_eq!(list.lookup(slot, generation).err(), Some(Error::StaleFunction));
                    }
                },
            }
            prop_assert_eq!(list.len(), model.len());
            for (name, (definition, handler, slot, generation)) in &model {
                let function = list.lookup(*slot, *generation).unwrap();
                prop_assert_eq!(function.signature, definition.signature());
                prop_assert_eq!(function.handler, handler);
                prop_assert_eq!(list.find(&format!("f{name}")), Some(*slot));
            }
        }
    }

    #[test]
    fn their_list_behaves_like_a_map(
        news in prop::collection::vec((0..12_u16, any::<u16>(), prop::option::weighted(0.8, (0..12_u8, 0..4_u8))), 0..60)
    ) {
        let mut list = theirs(6, 90);
        let mut model = BTreeMap::<u16, (u16, Definition)>::new();
        let mut skipped = 0;
        for (slot, generation, function) in news {
            let removed = model.remove(&slot).is_some();
            let Some((name, arguments)) = function else {
                prop_assert_eq!(list.remove(Slot(slot)), removed);
                continue;
            };
            let new = sample(name, arguments);
            model.retain(|_, (_, old)| old.name() != new.name());
            let used: usize = model.values().map(|(_, old)| old.as_bytes().len()).sum();
            let fits = model.len() < 6 && used + new.as_bytes().len() <= 90;
            let reported = list.insert(Slot(slot), Generation(generation), usual(), new.as_bytes());
            prop_assert_eq!(reported.is_ok(), fits);
            if fits {
                model.insert(slot, (generation, new));
            } else {
                skipped += 1;
            }
            prop_assert_eq!((list.len(), list.skipped()), (model.len(), skipped));
            for (slot, (generation, definition)) in &model {
                let function = list.function(Slot(*slot)).unwrap();
                prop_assert_eq!(function.signature, definition.signature());
                prop_assert_eq!(function.generation, Generation(*generation));
                prop_assert_eq!(list.find(definition.name()), Some(Slot(*slot)));
            }
            let mut lines: Vec<String> = model.values().map(|(_, definition)| format!("{definition}")).collect();
            lines.sort();
            let shown = format!("{}", list.show_functions());
            let mut found: Vec<&str> = shown.lines().collect();
            found.sort_unstable();
            prop_assert_eq!(found, lines);
        }
    }
}
