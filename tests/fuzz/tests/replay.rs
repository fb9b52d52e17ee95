//! Each input of the corpora, and each that has made a target panic, is run again.

use std::fs;
use std::path::Path;

use cara_fuzz::TARGETS;

#[test]
fn every_input_that_was_found_is_run_again() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    for target in TARGETS {
        let corpus = folder.join("corpus").join(target.name).with_extension("inputs");
        let corpus = fs::read(corpus).expect("each target has a corpus");
        let inputs: Vec<_> = cara_fuzz::inputs(&corpus).collect();
        assert!(inputs.len() > 20, "{} has {} inputs", target.name, inputs.len());
        inputs.into_iter().for_each(target.run);
    }
    // The name of a crash begins with that of its target.
    for crash in fs::read_dir(folder.join("crashes")).into_iter().flatten() {
        let path = crash.expect("it can be read").path();
        let name = path.file_name().and_then(|name| name.to_str()).and_then(|name| name.split('-').next());
        let target = name.and_then(cara_fuzz::target).expect("a crash has a target");
        println!("{}", path.display());
        (target.run)(&fs::read(&path).expect("it can be read"));
    }
}
