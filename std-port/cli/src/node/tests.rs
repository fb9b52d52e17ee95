use cara_std::control::Control;
use cara_std::{Capacities, Constraints, Definition, Parameters};
use proptest::prelude::*;

use super::file::Role;
use super::json::{self, BadOutput};
use super::mistake::Source;
use super::settings::{Overrides, Settings};
use super::{EXAMPLE, limits};
use cara_tools::keys::Keys;

fn settings(text: &str) -> Result<Settings, String> {
    settings_over(text, &Overrides::default())
}

fn settings_over(text: &str, over: &Overrides) -> Result<Settings, String> {
    let source = Source { name: "test.toml".into(), text: text.into() };
    Settings::of(source, over).map_err(|mistakes| mistakes.to_string())
}

#[test]
fn a_port_of_metrics_without_an_address_is_told_with_both() {
    let reported = super::address(":80").unwrap_err();
    assert!(
        reported.contains("127.0.0.1:80") && reported.contains("0.0.0.0:80") && !reported.contains("names"),
        "{reported}"
    );
    assert!(super::address("localhost:80").unwrap_err().contains("names are not looked up"));
    assert!(super::address("127.0.0.1:80").is_ok());
}

#[test]
fn an_address_at_which_no_manager_can_be_is_a_mistake() {
    let of = |address: &str| {
        let manager = format!("[manager]\nname = \"depot\"\nid = 1\naddress = \"{address}\"\n");
        settings(&format!("name = \"agv\"\nid = 7\nrole = \"s_unit\"\nfleet = 1\n{manager}"))
    };
    assert!(of("192.168.1.5:21971").is_ok() && of("127.0.0.1:17001").is_ok());
    for wrong in [
        "[::1]:17001",
        "[::ffff:127.0.0.1]:17001",
        "127.0.0.1:0",
        "0.0.0.0:17001",
        "255.255.255.255:17001",
        "224.0.0.1:5",
    ] {
        let reported = of(wrong).err().unwrap_or_else(|| panic!("{wrong} is taken"));
        assert!(reported.contains("no manager can be reached at this address"), "{reported}");
    }
}

#[test]
fn the_example_shows_the_defaults() {
    let example = settings(EXAMPLE).unwrap();
    let least = settings("name = \"AGV_manager\"\nid = 1\n").unwrap();
    assert_eq!(example.constraints, limits::defaults(Role::MUnit, false));
    assert_eq!(example.capacities, Capacities::default());
    assert_eq!((example.fleet, &example.control), (least.fleet, &Control::Default));
    assert_eq!((&example.keys, &example.discovery_port), (&Keys::Found, &None));
    assert_eq!(
        (least.constraints, least.capacities, least.control),
        (example.constraints, example.capacities, example.control)
    );
    let over = Overrides { stands_by: true, ..Overrides::default() };
    let of_standby = |text: &str| settings_over(text, &over).unwrap().constraints;
    assert_eq!(of_standby("name = \"AGV_manager\"\nid = 1\n"), Constraints::STANDBY);
    assert_eq!(of_standby(EXAMPLE), Constraints::M_UNIT, "what is written counts");
}

#[test]
fn a_node_spins_for_a_millisecond_at_most_and_not_unless_it_is_told() {
    let spins =
        |line: &str| settings(&format!("name = \"a\"\nid = 1\n{line}\n")).map(|settings| settings.spin.as_micros());
    let told = ["", "spin = 0", "spin = \"100us\"", "spin = \"1ms\""].map(|line| spins(line).unwrap());
    assert_eq!(told, [0, 0, 100, 1_000]);
    let mistake = spins("spin = \"1001us\"").unwrap_err();
    assert!(mistake.contains("at most 1 ms"), "{mistake}");
}

/// With the comment signs of keys and tables taken out, the example is that of an s_unit.
#[test]
fn what_the_example_leaves_out_is_right_too() {
    let vehicle = EXAMPLE
        .replace("role = \"m_unit\"", "role = \"s_unit\"")
        .replace("# [manager]", "[manager]")
        .replace("# name = \"AGV_manager\"", "name = \"AGV_manager\"")
        .replace("# id = 1", "id = 1")
        .replace("# address = ", "address = ");
    let manager = settings(&vehicle).unwrap().manager.unwrap();
    assert_eq!((manager.name.as_str(), manager.id, manager.address.is_some()), ("AGV_manager", 1, true));
    let manager = EXAMPLE
        .replace("# tcp_port", "tcp_port")
        .replace("# discovery_port", "discovery_port")
        .replace("# m_units", "m_units")
        .replace("# keys", "keys");
    let manager = manager.replace("# path = ", "path = ");
    let manager = settings(&manager).unwrap();
    assert!(manager.tcp_port.is_some() && matches!(manager.control, Control::Path(_)));
    assert_eq!(manager.discovery_port.unwrap().value, cara_std::SECURED_PORT);
    assert!(matches!(manager.keys, Keys::File(_)));
    let m_units: Vec<_> = manager.m_units.unwrap().iter().map(ToString::to_string).collect();
    assert_eq!(m_units, ["station/2", "hall/3"]);
}

#[test]
fn operators_have_a_role_each_and_a_path() {
    let with = |control: &str| settings(&format!("name = \"a\"\nid = 1\n[control]\n{control}\n"));
    let path = "path = \"/run/cara/a.sock\"";
    let shared = EXAMPLE.replace("# path = ", "path = ").replace("# operators = ", "operators = ");
    assert!(
        matches!(settings(&shared).unwrap().control, Control::Shared(_, operators) if operators != Default::default())
    );
    for (wrong, told) in [
        (format!("{path}\noperators = {{ 4711 = \"stopp\" }}"), "did you mean `stop`?"),
        (format!("{path}\noperators = {{ 4711 = \"stop\", 04711 = \"see\" }}"), "are the same user"),
        (format!("{path}\noperators = {{ 4711 = \"stop\", 4711 = \"see\" }}"), "duplicate key"),
        (format!("{path}\noperators = {{ nobody-has-this-name = \"stop\" }}"), "no user 'nobody-has-this-name'"),
        ("operators = { 4711 = \"stop\" }".to_owned(), "write path = "),
    ] {
        let mistake = with(&wrong).unwrap_err();
        assert!(mistake.contains(told), "{mistake}");
    }
}

#[test]
fn the_command_line_stands_above_the_file() {
    let text = "name = \"a\"\nid = 1\nfleet = 1\nm_units = []\ntcp_port = 1\nmetrics.listen = \"127.0.0.1:1\"\n";
    let source = Source { name: "test.toml".into(), text: text.into() };
    let over = Overrides {
        name: Some("b".into()),
        id: Some(2),
        fleet: Some(3),
        tcp_port: Some(4),
        discovery_port: Some(5),
        m_units: vec!["hall/3".parse().unwrap()],
        metrics: Some(([127, 0, 0, 1], 6).into()),
        ..Overrides::default()
    };
    let settings = Settings::of(source, &over).unwrap();
    assert_eq!((settings.name.as_str(), settings.id, settings.fleet), ("b", 2, 3));
    assert_eq!(settings.m_units, Some(vec!["hall/3".parse().unwrap()]));
    let port = |port: Option<super::settings::Placed<u16>>| port.map(|port| port.value);
    assert_eq!((port(settings.tcp_port), port(settings.discovery_port)), (Some(4), Some(5)));
    assert_eq!(settings.metrics.map(|metrics| metrics.value.port()), Some(6));
}

fn all_types() -> Definition {
    let list = "(n: int, ns: int[2], x: float[3], b: bool, s: string[8], d: bytes[4])";
    Definition::parse(&format!("f{list} -> {list}")).unwrap()
}

fn parameters(definition: &Definition) -> Parameters {
    let mut parameters = Parameters::new();
    for result in definition.signature().results() {
        parameters.add(result.name, result.kind, result.size).unwrap();
    }
    parameters
}

#[test]
fn parameters_travel_through_json() {
    let definition = all_types();
    let mut sent = parameters(&definition);
    sent.set_value("n", -1).unwrap();
    sent.set_value("ns", [i64::MIN, i64::MAX]).unwrap();
    sent.set_value("x", [0.1, f64::INFINITY, f64::NAN]).unwrap();
    sent.set_value("b", true).unwrap();
    sent.set_value("s", "grün\"").unwrap();
    sent.set_value("d", &[0_u8, 0xFF][..]).unwrap();
    let text = json::arguments(definition.signature(), &sent).to_string();
    let expected = r#"{"n":-1,"ns":[-9223372036854775808,9223372036854775807],"x":[0.1,"inf","NaN"],"b":true,"s":"grün\"","d":"00ff"}"#;
    assert_eq!(text, expected);
    let mut received = parameters(&definition);
    json::set_results(definition.signature(), text.as_bytes(), &mut received).unwrap();
    assert_eq!(json::arguments(definition.signature(), &received).to_string(), expected);
}

#[test]
fn results_that_do_not_fit_are_told_by_name() {
    let definition = Definition::parse("f() -> (n: int, s: string[2])").unwrap();
    let outcome = |text: &str| json::set_results(definition.signature(), text.as_bytes(), &mut parameters(&definition));
    assert_eq!(outcome(r#"{"n": [1], "s": "ab", "more": 1}"#), Ok(()));
    assert!(matches!(outcome("no"), Err(BadOutput::NotJson(_))));
    assert!(matches!(outcome(""), Err(BadOutput::NotJson(_))));
    assert_eq!(outcome("[1]"), Err(BadOutput::NotAnObject));
    assert_eq!(outcome(r#"{"n": 1}"#), Err(BadOutput::Missing("s".into())));
    for wrong in [r#"{"n": 1.5, "s": ""}"#, r#"{"n": [1, 2], "s": ""}"#, r#"{"n": 9223372036854775808, "s": ""}"#] {
        assert!(matches!(outcome(wrong), Err(BadOutput::Wrong(bad)) if bad.path == "n"), "{wrong}");
    }
    for wrong in [r#"{"n": 1, "s": "abc"}"#, r#"{"n": 1, "s": 1}"#, r#"{"n": 1, "s": null}"#] {
        let bad = outcome(wrong).unwrap_err().to_string();
        assert!(bad.starts_with("its output does not fit its results: s: expected string[2], got "), "{bad}");
    }
}

/// A line of a file that is anything at all.
fn line() -> impl Strategy<Value = String> {
    prop_oneof![
        "[a-z_]{1,8} = .{0,12}",
        r#"(name|role|interfaces|tcp_port|id) = ["']?[ -~]{0,8}["']?"#,
        r#"signature = "[a-z(): ,\[\]>0-9-]{0,30}""#,
        r"\[{1,2}(manager|constraints|capacities|control|metrics|log|functions)\]{1,2}",
        r#"(chunk_size|keep_alive|maximum_nodes|message_size) = "?-?[0-9]{1,20}(ms|KiB|s)?"?"#,
    ]
}

proptest! {
    #[test]
    fn no_file_makes_it_panic(lines in prop::collection::vec(line(), 0..12)) {
        if let Err(shown) = settings(&lines.join("\n")) {
            prop_assert!(shown.starts_with("test.toml:"), "{}", shown);
        }
    }

    #[test]
    fn no_output_makes_it_panic(output in prop::collection::vec(any::<u8>(), 0..64), text in r#"\{"[nsxbd]": .{0,12}\}"#) {
        let definition = all_types();
        for output in [&output[..], text.as_bytes()] {
            let _ = json::set_results(definition.signature(), output, &mut parameters(&definition));
        }
    }
}
