//! What is printed is compiled here, and has the signatures that it was printed from.

use cara_std::Attributes;
use cara_std::control::protocol::FunctionInfo;

use super::{interface, trait_name};

const SOURCE: &str = include_str!("agv.rs");

/// The printed trait.
mod printed {
    #![allow(unreachable_pub, dead_code, missing_docs)]
    #![allow(clippy::too_many_arguments, reason = "an interface may have functions of many")]
    include!("agv.rs");

    /// Signatures and attributes.
    pub(super) fn functions() -> Vec<(cara_std::Signature<'static>, cara_std::Attributes)> {
        type Of = __Agv17Functions;
        let signatures = [
            Of::SIGNATURE_pos_info,
            Of::SIGNATURE_go_to,
            Of::SIGNATURE_stop,
            Of::SIGNATURE_reset,
            Of::SIGNATURE_log_line,
            Of::SIGNATURE_plan,
            Of::SIGNATURE_dock,
            Of::SIGNATURE_undock,
            Of::SIGNATURE_lift,
        ];
        let attributes = [
            Of::ATTRIBUTES_pos_info,
            Of::ATTRIBUTES_go_to,
            Of::ATTRIBUTES_stop,
            Of::ATTRIBUTES_reset,
            Of::ATTRIBUTES_log_line,
            Of::ATTRIBUTES_plan,
            Of::ATTRIBUTES_dock,
            Of::ATTRIBUTES_undock,
            Of::ATTRIBUTES_lift,
        ];
        signatures.into_iter().zip(attributes).collect()
    }
}

#[test]
fn the_printed_trait_is_the_one_that_was_published() {
    let of = |(signature, attributes): (cara_std::Signature<'_>, Attributes)| {
        let moves = ["go_to", "stop"].contains(&signature.name());
        FunctionInfo {
            name: signature.name().to_owned(),
            signature: signature.to_string(),
            attributes: Attributes { actuator: if moves { 3 } else { 0 }, ..attributes },
            help: signature.help().to_owned(),
            units: signature.units().map(|(variable, unit)| (variable.to_owned(), unit.to_owned())).collect(),
        }
    };
    let published: Vec<FunctionInfo> = printed::functions().into_iter().map(of).collect();
    assert_eq!(
        published[4].signature,
        "log/line(line: string[64], a-b: float, a.b: bool, type: int, self: int, _raw: bytes[8], 2nd: int) -> \
         (text: string[9], is-new: bool)"
    );
    assert_eq!(
        published[5].signature,
        "plan(nodes: {id: string[32], at-m: float[2], actions: {kind: string[8], type: int}[..4], note: string[20]?}[..50], \
         start: {x: float}, speed: float?) -> (last: {x: float}?, photos: bytes[3]?)"
    );
    assert_eq!(published[6].signature, "dock(call: int) progress (left: float) fails (at: int[2], by: string[8])");
    assert_eq!(published[8].signature, "lift() fails (at: int[2], by: string[8])");
    assert_eq!(interface("agv-17/17", &published).unwrap(), SOURCE);
    let broken = FunctionInfo { signature: "f(".into(), ..published[0].clone() };
    assert!(interface("agv", &[broken]).unwrap_err().contains("f("));
}

#[test]
fn streams_are_printed_as_structs() {
    let attributes = Attributes { priority: cara_std::Priority::Low, stream: Some(20), ..Attributes::default() };
    let stream = |name: &str, signature: &str| FunctionInfo {
        name: name.into(),
        signature: signature.into(),
        attributes,
        ..FunctionInfo::default()
    };
    let units = [("position".to_owned(), "m".to_owned())].into();
    let functions = [
        FunctionInfo { help: "Where it is\nnow.".into(), units, ..stream("pose", "pose() -> (position: float[2])") },
        FunctionInfo { attributes: Attributes::default(), ..stream("stop", "stop()") },
        stream("at_dock", "at_dock() -> (position: float[2])"),
        stream("at_door", "at_door() -> (position: float[2])"),
    ];
    let source = interface("agv/17", &functions).unwrap();
    let derive = "#[derive(Variables, Clone, Debug, PartialEq)]\npub struct";
    let structs = format!(
        "// Where it is now.\n{derive} Pose {{\n    #[unit = \"m\"]\n    pub position: [f64; 2],\n}}\n\n\
         {derive} AtDock {{\n    pub position: [f64; 2],\n}}\n\n"
    );
    let streams = "// Values of the stream `pose` are a `Pose`.\n// Values of the stream `at_dock` are a `AtDock`.\n\
                   // Values of the stream `at_door` are a `AtDock`.\n";
    assert!(source.contains(&format!("{structs}{streams}#[interface]")), "{source}");
    assert_eq!(source.matches("fn ").count(), 1, "{source}");
}

#[test]
fn a_nodes_name_becomes_that_of_a_trait() {
    for (node, name) in [("agv-17/17", "Agv17"), ("AGV_manager/1", "AGVManager"), ("7up", "Node7up"), ("ä/1", "Node")]
    {
        assert_eq!(trait_name(node), name);
    }
}
