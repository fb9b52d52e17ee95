//! Groups that failed and run once more: which ones may, and which tests were flaky if they pass then.

use crate::groups::{Group, Outcome};

/// Groups that never run again: a failure that comes and goes in there is a fault of what ships.
const ONCE: [&str; 5] = ["loom", "scenarios", "security", "faults", "firmware"];

/// The same for programs of `unit`, as cargo names those that failed: the core, on its own and on the simulator.
const ONCE_IN_UNIT: [&str; 6] = [
    "`-p cara-core ",
    "`-p cara-derive ",
    "`-p cara-secure ",
    "`-p cara-sim ",
    "`-p cara-scenarios --test simulator`",
    "`-p cara-scenarios --test secured`",
];

/// Whether a group that printed this and failed may run once more.
pub(crate) fn may_run(group: &Group, outcome: &Outcome, output: &str) -> bool {
    let has_core = || ONCE_IN_UNIT.iter().any(|program| output.contains(program));
    matches!(outcome, Outcome::Failed(_)) && !ONCE.contains(&group.name) && !has_core()
}

/// The tests that failed, by what libtest and the scenarios print of each; the reason, if no test is named.
pub(crate) fn failed_tests(output: &str, reason: &str) -> Vec<String> {
    let name = |line: &str| Some(line.strip_prefix("test ")?.split_once(" ... FAILED")?.0.to_owned());
    let mut names: Vec<String> = output.lines().filter_map(name).collect();
    names.dedup();
    if names.is_empty() { vec![reason.to_owned()] } else { names }
}

#[cfg(test)]
mod tests {
    use super::{ONCE, failed_tests, may_run};
    use crate::groups::{GROUPS, Group, Outcome};

    fn group(name: &str) -> &'static Group {
        GROUPS.iter().find(|group| group.name == name).unwrap()
    }

    fn failed() -> Outcome {
        Outcome::Failed("exit code 101".into())
    }

    #[test]
    fn what_never_runs_again_is_a_group() {
        for name in ONCE {
            assert!(!may_run(group(name), &failed(), ""), "{name}");
        }
    }

    #[test]
    fn only_what_failed_runs_again() {
        assert!(may_run(group("guide"), &failed(), ""));
        assert!(!may_run(group("guide"), &Outcome::Passed, ""));
        assert!(!may_run(group("guide"), &Outcome::Skipped("no root".into()), ""));
    }

    /// As cargo ends a run of several programs, and of one.
    #[test]
    fn tests_of_the_core_run_once() {
        let several =
            |program: &str| format!("error: 2 targets failed:\n    `-p cara-std --lib`\n    `-p {program}`\n");
        let one = |program: &str| format!("error: test failed, to rerun pass `-p {program}`\n");
        for program in ["cara-core --lib", "cara-core --doc", "cara-secure --test vectors", "cara-sim --test orders"] {
            assert!(!may_run(group("unit"), &failed(), &several(program)), "{program}");
            assert!(!may_run(group("unit"), &failed(), &one(program)), "{program}");
        }
        assert!(!may_run(group("unit"), &failed(), &several("cara-scenarios --test simulator")));
        for program in ["cara-scenarios --test linux", "cara-cli --test cara", "cara-std --test port"] {
            assert!(may_run(group("unit"), &failed(), &several(program)), "{program}");
            assert!(may_run(group("unit"), &failed(), &one(program)), "{program}");
        }
    }

    #[test]
    fn failed_tests_are_read_from_the_output() {
        let output = "test a::good ... ok\ntest access::a_file ... FAILED\ntest late_reset ... FAILED (31 ms)\n\
                      test std-port/src/lib.rs - (line 5) ... FAILED\ntest result: FAILED. 1 passed; 3 failed\n";
        assert_eq!(failed_tests(output, "x"), ["access::a_file", "late_reset", "std-port/src/lib.rs - (line 5)"]);
        assert_eq!(failed_tests("the page does not answer", "exit code 1"), ["exit code 1"]);
    }
}
