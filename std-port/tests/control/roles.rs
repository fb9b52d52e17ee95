//! What each role may do, and who has which.

use std::os::unix::fs::{PermissionsExt, chown};
use std::os::unix::process::CommandExt;
use std::process::Command;

use cara_std::control::protocol::{Answer, Failure, Question};
use cara_std::control::{Client, Control, ControlError, OperatorError, Operators, Role};

use crate::audit::Audited;
use crate::support::{Depot, ask, call, manager, until};

const ROLES: [Role; 4] = [Role::Stop, Role::See, Role::Operate, Role::Reset];

fn of_call(function: &str) -> Question {
    Question::Call(call(Some("agv"), function, vec![]))
}

fn of_hold(function: &str) -> Question {
    Question::Hold(call(Some("agv"), function, vec![]))
}

fn acting(name: &str, role: Role) -> Question {
    Question::As { name: name.to_owned(), role }
}

#[test]
fn each_role_has_its_verbs_and_all_of_them_stop() {
    let audited = Audited::new();
    let node = || "agv".to_owned();
    let to_all = |function| Question::Call(call(None, function, vec![]));
    let taking = |function| {
        let mut question = call(Some("agv"), function, vec![]);
        question.take_over = true;
        Question::Call(question)
    };
    let table = [
        (Role::Stop, Question::Stop { node: None }),
        (Role::Stop, Question::Stop { node: Some(node()) }),
        (Role::Stop, Question::Unit),
        (Role::Stop, Question::Nodes { offering: None }),
        (Role::Stop, of_call("halt")),
        (Role::Stop, to_all("brake")),
        (Role::See, Question::Functions { node: node() }),
        (Role::See, Question::Orders { node: None }),
        (Role::See, Question::Watch),
        (Role::See, Question::Commands),
        (Role::See, Question::Stream { node: node(), name: None, interval_ms: 0 }),
        (Role::See, Question::Streams { interval_ms: 0, names: Vec::new() }),
        (Role::See, Question::Counters { node: None }),
        (Role::See, Question::Metrics),
        (Role::See, Question::Search),
        (Role::See, Question::Ping { node: node(), count: 1, pause_us: 0, timeout_ms: 1 }),
        (Role::Operate, of_call("drive")),
        (Role::Operate, of_call("echo")),
        (Role::Operate, of_call("unknown")),
        (Role::Operate, taking("halt")),
        (Role::Operate, of_hold("drive")),
        (Role::Operate, of_hold("halt")),
        (Role::Operate, Question::Publish { node: None, timeout_ms: 1 }),
        (Role::Operate, Question::HandOver { node: node(), to: "yard/2".to_owned(), timeout_ms: 1 }),
        (Role::Reset, of_call("free")),
        (Role::Reset, to_all("free")),
        (Role::Reset, of_hold("free")),
        (Role::Reset, Question::Reset { node: None }),
        (Role::Reset, Question::Retire { node: node() }),
        (Role::Reset, Question::Set { node: None, constraint: "keep_alive".to_owned(), value: 1 }),
    ];
    for (needed, question) in &table {
        for role in ROLES {
            let permitted = role.permit(&audited.depot.system, question);
            assert_eq!(permitted.is_ok(), role >= *needed, "{role}: {question:?}");
            if let Err(failure) = permitted {
                assert_eq!(failure.error, "NotAllowed");
                assert!(failure.text.contains(&format!("needs the role `{needed}`")), "{failure}");
            }
        }
    }
}

#[test]
fn a_connection_that_acts_for_somebody_has_their_role_and_name() {
    let audited = Audited::new();
    let mut client = audited.depot.client();
    let refused = |outcome: Result<_, Failure>| outcome.is_err_and(|failure| failure.error == "NotAllowed");
    ask(&mut client, acting("bert", Role::See)).unwrap();
    let changes = [of_call("drive"), Question::Reset { node: None }];
    changes.into_iter().for_each(|question| assert!(refused(ask(&mut client, question))));
    assert!(!ask(&mut client, Question::Orders { node: None }).unwrap().is_empty());
    assert!(refused(ask(&mut client, acting("anna", Role::Reset))), "nobody raises his role");
    for name in ["", "a\nb", &"x".repeat(65)] {
        assert!(ask(&mut client, acting(name, Role::See)).is_err(), "{name}");
    }
    ask(&mut client, Question::Stop { node: None }).unwrap();
    ask(&mut audited.depot.client(), Question::Stop { node: None }).unwrap();
    let lines = || audited.lines();
    until("it is noted", || lines().len() >= 4);
    let noted: Vec<_> =
        lines()[..3].iter().map(|line| ["ask", "name", "role", "outcome"].map(|key| line[key].clone())).collect();
    let expected =
        [["call", "bert", "see", "NotAllowed"], ["reset", "bert", "see", "NotAllowed"], ["stop", "bert", "see", "ok"]];
    assert_eq!(noted, expected.map(|words| words.map(serde_json::Value::from)));
    assert_eq!(lines()[3]["role"], "reset", "the unit's own user may do everything");
}

#[test]
fn an_operator_is_a_user_of_this_host_and_only_one() {
    let mut operators = Operators::default();
    operators.add("4711", Role::See).unwrap();
    operators.add("daemon", Role::Stop).unwrap();
    assert_eq!(operators.add("04711", Role::Stop), Err(OperatorError::Doubled("4711".to_owned(), "04711".to_owned())));
    assert!(matches!(operators.add("nobody-has-this-name", Role::Stop), Err(OperatorError::Unknown(_))));
}

/// Which socket the process of another user asks.
const SHARED: &str = "CARA_TEST_SHARED";
const USER: u32 = 4711;

/// Its clients are processes of this same test, as other users.
#[test]
fn other_users_are_let_in_with_their_roles() {
    if let Some(path) = std::env::var_os(SHARED) {
        let mut client = Client::connect(path.as_ref()).unwrap();
        assert!(matches!(ask(&mut client, acting("root", Role::Stop)), Err(failure) if failure.error == "NotAllowed"));
        assert!(ask(&mut client, Question::Reset { node: None }).is_err());
        let _held: Vec<_> = (0..3).map(|_| Client::connect(path.as_ref()).unwrap()).collect();
        assert!(
            matches!(Client::connect(path.as_ref()), Err(ControlError::Full { .. })),
            "a user has some of them only"
        );
        ask(&mut Client::connect_to_stop(path.as_ref()).unwrap(), Question::Stop { node: None }).unwrap();
        return;
    }
    let mut operators = Operators::default();
    operators.add(&USER.to_string(), Role::See).unwrap();
    let depot = Depot::of(|fleet, directory| {
        std::fs::set_permissions(directory, std::fs::Permissions::from_mode(0o750)).unwrap();
        let _ = chown(directory, None, Some(USER));
        let shared = Control::Shared(directory.join("manager.sock"), operators);
        manager("manager", 1, fleet).control(shared).audit(directory.join("audit")).unwrap()
    });
    assert!(
        matches!(ask(&mut depot.client(), Question::Unit).unwrap()[..], [Answer::Unit(_)]),
        "its own user comes in"
    );
    let reached = std::env::temp_dir().join(format!("cara-roles-{}", std::process::id()));
    let _ = std::fs::copy(std::env::current_exe().unwrap(), &reached);
    let _ = std::fs::set_permissions(&reached, std::fs::Permissions::from_mode(0o755));
    let asked_by = |user: u32| {
        let mut command = Command::new(&reached);
        command.args(["--exact", "roles::other_users_are_let_in_with_their_roles"]);
        command.env(SHARED, depot.path()).uid(user).gid(USER).output()
    };
    let (listed, stranger) = (asked_by(USER), asked_by(USER + 1));
    let _ = std::fs::remove_file(&reached);
    let (Ok(listed), Ok(stranger)) = (listed, stranger) else {
        println!("skipped: only root can be other users");
        return;
    };
    let text =
        |output: std::process::Output| String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert!(listed.status.success(), "{}", text(listed));
    let text = text(stranger);
    assert!(text.contains("have yours added"), "{text}");
    let lines = || std::fs::read_to_string(depot.directory.path().join("audit")).unwrap();
    until("it is noted", || lines().lines().count() >= 2);
    assert!(lines().contains("\"uid\":4711") && lines().matches("\"role\":\"see\"").count() == 2, "{}", lines());
}
