//! `docs/porting.md` says what the files say: its excerpts, its count of lines, the tests that it names.

use std::fs::{read_dir, read_to_string};
use std::path::{Path, PathBuf};

const GAP: &str = "// …";

fn here(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn text(path: &Path) -> String {
    read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn page() -> String {
    text(&here("../../docs/porting.md"))
}

fn sources(folder: &str) -> Vec<String> {
    let files = read_dir(here(folder)).unwrap().map(|entry| entry.unwrap().path());
    files.filter(|path| path.extension().is_some_and(|extension| extension == "rs")).map(|path| text(&path)).collect()
}

fn trimmed(text: &str) -> Vec<&str> {
    text.lines().map(str::trim).collect()
}

#[test]
fn the_page_counts_the_lines_of_the_port() {
    let sources = sources("src");
    let lines = || sources.iter().flat_map(|source| trimmed(source));
    let code = lines().filter(|line| !line.is_empty() && !line.starts_with("//")).count();
    let said = format!("**{} lines, {code} of them code**", lines().count());
    assert!(page().contains(&said), "docs/porting.md should say: {said}");
}

#[test]
fn every_excerpt_stands_in_its_file() {
    let page = page();
    let blocks: Vec<&str> = page.split("```rust\n").skip(1).map(|block| block.split("```").next().unwrap()).collect();
    assert!(blocks.len() > 5, "where are the excerpts?");
    for block in blocks {
        let (file, excerpt) = block.split_once('\n').unwrap();
        let source = text(&here("src").join(file.trim_start_matches("// ")));
        let (source, excerpt) = (trimmed(&source), trimmed(excerpt));
        for part in excerpt.split(|line| *line == GAP) {
            assert!(
                source.windows(part.len()).any(|lines| lines == part),
                "{file} has no longer:\n{}",
                part.join("\n")
            );
        }
    }
}

#[test]
fn every_test_that_the_page_names_exists() {
    let (page, tests) = (page(), sources("tests/port").join("\n") + &sources("tests/tap").join("\n"));
    let list = page.split("## What a port must pass").nth(1).unwrap().split("\n## ").next().unwrap();
    let names = list.split('`').skip(1).step_by(2).filter(|name| name.matches('_').count() > 2);
    let missing: Vec<_> = names
        .clone()
        .filter(|name| !tests.contains(&format!("#[test]\nfn {}(", name.rsplit("::").next().unwrap())))
        .collect();
    assert_eq!(missing, Vec::<&str>::new());
    assert!(names.count() > 15);
}
