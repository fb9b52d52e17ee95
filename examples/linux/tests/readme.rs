//! The README's listing is the example's, so that a copy of it is tested code.

/// The lines behind the one of the paper's line 1, which differs: the example takes the name from its command line.
fn listing(text: &str, begin: &str, end: &str) -> Vec<String> {
    let text = text.split_once(begin).expect(begin).1.split_once(end).expect(end).0;
    let lines = text.lines().map(str::trim).skip_while(|line| !line.ends_with("// 1")).skip(1);
    lines.filter(|line| !line.starts_with("transcript.")).map(str::to_owned).collect()
}

fn numbers(listing: &[String]) -> Vec<u32> {
    let comments = listing.iter().filter_map(|line| line.rsplit_once("// ").map(|(_, comment)| comment));
    comments.flat_map(|comment| comment.split(", ")).filter_map(|number| number.parse().ok()).collect()
}

#[test]
fn the_readme_shows_the_example() {
    let readme = listing(include_str!("../../../README.md"), "### The listing", "    Ok(())");
    let example = listing(include_str!("../src/bin/agv_manager/main.rs"), "// README begins.", "// README ends.");
    assert_eq!(readme, example.iter().map(|line| line.trim_end()).filter(|line| !line.is_empty()).collect::<Vec<_>>());
}

#[test]
fn every_line_of_the_paper_is_there_in_its_order() {
    let mut found = numbers(&listing(include_str!("../../../README.md"), "### The listing", "    Ok(())"));
    found.dedup();
    assert_eq!(found, (2..=24).collect::<Vec<_>>());
}
