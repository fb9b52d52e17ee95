//! An earlier run that ended too soon: what it completed need not be measured again.

use std::path::Path;

use anyhow::{Result, ensure};

use super::simulated::SIMULATED;
use crate::peers::OutsideReport;
use crate::results::{About, Results};

/// The earlier run, if its rows may stand beside those of `this`.
pub(super) fn read(path: &Path, this: &About) -> Result<Results> {
    let earlier = Results::read(path)?;
    let of = |run: &About| {
        [
            ("commit", run.commit.clone()),
            ("extent", run.extent.clone()),
            ("processor", run.processor.clone()),
            ("number of CPUs", run.cpus.to_string()),
            ("loss on links", format!("{} %", run.loss_percent)),
            ("build", if run.is_release_build { "release" } else { "debug" }.to_owned()),
        ]
    };
    for ((what, then), (_, now)) in of(&earlier.run).into_iter().zip(of(this)) {
        let path = path.display();
        ensure!(then == now, "{path} cannot be resumed: its {what} is {then:?} and not {now:?}; leave out --resume");
    }
    Ok(earlier)
}

/// Whether the earlier run ended this experiment.
pub(super) fn has(earlier: &Results, experiment: &str) -> bool {
    earlier.run.experiments.iter().any(|done| done.experiment == experiment && done.is_complete)
}

/// Takes the experiment's rows.
pub(super) fn keep(earlier: &Results, experiment: &str, into: &mut Results) {
    let earlier = earlier.clone();
    match experiment {
        "response" => into.response = earlier.response,
        "echoes" => into.echoes = earlier.echoes,
        "throughput" => into.throughput = earlier.throughput,
        "share" => into.share = earlier.share,
        "scale" => into.scale = earlier.scale,
        "constraints" => into.constraints = earlier.constraints,
        "availability" => into.availability = earlier.availability,
        "link" => {
            into.link_response = earlier.link_response;
            into.link_availability = earlier.link_availability;
            into.link_constraints = earlier.link_constraints;
            into.link_response.retain(|on| on.row.as_ref().is_none_or(|row| row.peer != SIMULATED));
            into.link_availability.retain(|on| on.row.as_ref().is_none_or(|row| row.peer != SIMULATED));
        }
        // Its rows stand among those of the link.
        "simulated" => {
            let (responses, availabilities) = (earlier.link_response, earlier.link_availability);
            let is_ours = |peer: &str| peer == SIMULATED;
            let responses = responses.into_iter().filter(|on| on.row.as_ref().is_some_and(|row| is_ours(&row.peer)));
            into.link_response.extend(responses);
            let rows = availabilities.into_iter().filter(|on| on.row.as_ref().is_some_and(|row| is_ours(&row.peer)));
            into.link_availability.extend(rows);
        }
        _ => return,
    }
    into.run.experiments.extend(earlier.run.experiments.into_iter().filter(|done| done.experiment == experiment));
}

/// What the other systems did not do in the earlier run.
pub(super) fn add_notes(earlier: &[OutsideReport], reports: &mut [OutsideReport]) {
    for report in reports {
        let notes = earlier.iter().filter(|known| known.peer == report.peer).flat_map(|known| &known.notes);
        let fresh: Vec<String> = notes.filter(|note| !report.notes.contains(note)).cloned().collect();
        report.notes.extend(fresh);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::Done;

    fn run(commit: &str) -> Results {
        let done =
            |experiment: &str, is_complete| Done { experiment: experiment.into(), is_complete, ..Done::default() };
        let experiments = vec![done("response", true), done("scale", false)];
        Results { run: About { commit: commit.into(), experiments, ..About::default() }, ..Results::default() }
    }

    #[test]
    fn only_the_same_commit_and_loss_are_resumed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows.json");
        run("abc").write(&path).unwrap();
        let earlier = read(&path, &run("abc").run).unwrap();
        assert!(has(&earlier, "response") && !has(&earlier, "scale") && !has(&earlier, "share"));
        let refused = read(&path, &run("def").run).unwrap_err();
        assert!(refused.to_string().contains("commit"), "{refused}");
        let refused = read(&path, &About { loss_percent: 1, ..run("abc").run }).unwrap_err();
        assert!(refused.to_string().contains("loss"), "{refused}");
    }

    #[test]
    fn what_is_kept_is_told_once() {
        let mut into = Results::default();
        keep(&run("abc"), "response", &mut into);
        assert_eq!(into.run.experiments.len(), 1);
    }
}
