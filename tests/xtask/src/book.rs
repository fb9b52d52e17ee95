//! The documents as a book in HTML, with a search that needs no network.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Error, Result, ensure};

use crate::command::Run;
use crate::install;
use crate::workspace;

/// Makes it in `target/book`, and returns that folder.
pub(crate) fn make() -> Result<PathBuf> {
    let folder = workspace::target().join("book");
    let tool = install::crate_program("mdbook", "0.4.52").map_err(Error::msg)?;
    if folder.exists() {
        fs::remove_dir_all(&folder)?;
    }
    Run::new(&tool.to_string_lossy()).args(["build", "--dest-dir"]).args([&folder]).args(["."]).stream()?;
    let (mut pages, mut links) = (0, 0);
    for page in Run::new("find").args([&folder]).args(["-name", "*.html"]).text()?.lines().map(Path::new) {
        let text = fs::read_to_string(page)?;
        ensure!(!loads_from_elsewhere(&text), "{} takes something from the network", page.display());
        let directory = page.parent().context("a page lies in a folder")?;
        let text = with_plots(&text, &folder)?;
        let (text, kept) = without_links_outwards(&text, |target| directory.join(target).is_file());
        fs::write(page, text)?;
        (pages, links) = (pages + 1, links + kept);
    }
    for needed in ["index.html", "searchindex.js", "safety.html", "plots/figure-6.svg"] {
        ensure!(folder.join(needed).is_file(), "the book has no {needed}");
    }
    println!("{}: {pages} pages, {links} links between them", folder.display());
    Ok(folder)
}

/// Where the documents' figures lie, as they name it.
const PLOTS: &str = "../tests/experiments/plots/";

/// The page with its figures, which are copied into the book.
fn with_plots(page: &str, book: &Path) -> Result<String> {
    for rest in page.split(&format!("<img src=\"{PLOTS}")).skip(1) {
        let name = rest.split('"').next().unwrap_or_default();
        let figure = workspace::root().join("docs").join(PLOTS).join(name);
        fs::create_dir_all(book.join("plots"))?;
        fs::copy(&figure, book.join("plots").join(name)).with_context(|| figure.display().to_string())?;
    }
    let page = page.replace(&format!("<img src=\"{PLOTS}"), "<img src=\"plots/");
    ensure!(!page.contains("<img src=\"../"), "a figure is not in the book");
    Ok(page)
}

/// Whether a browser that opens the page asks another host for anything.
fn loads_from_elsewhere(page: &str) -> bool {
    let elements = ["<script", "<link", "<img"];
    let mut tags = page.split_inclusive('>').filter_map(|piece| piece.rfind('<').map(|start| &piece[start..]));
    tags.any(|tag| elements.iter().any(|element| tag.starts_with(element)) && tag.contains("=\"http"))
}

/// A page whose links to files that the book does not have, such as sources, are plain text; and how many of the others it has.
fn without_links_outwards(page: &str, has: impl Fn(&str) -> bool) -> (String, usize) {
    let (mut text, mut rest, mut kept) = (String::new(), page, 0);
    while let Some((before, link)) = rest.split_once("<a href=\"") {
        text += before;
        let target = link.split('"').next().unwrap_or_default();
        let file = target.split('#').next().unwrap_or_default();
        rest = match (target.contains("://"), file.is_empty() || has(file), link.split_once('>')) {
            (false, false, Some((_, inside))) => {
                let (inside, behind) = inside.split_once("</a>").unwrap_or((inside, ""));
                text += inside;
                behind
            }
            (is_address, ..) => {
                kept += usize::from(!is_address);
                text += "<a href=\"";
                link
            }
        };
    }
    (text + rest, kept)
}

#[cfg(test)]
mod tests {
    use super::{loads_from_elsewhere, without_links_outwards};
    use crate::workspace;

    #[test]
    fn links_outwards_become_text() {
        let page = r##"<p><a href="a.html#x">a</a>, <a href="../src/b.rs">b <code>c</code></a>, <a href="#d">d</a>, <a href="https://e.org">e</a></p>"##;
        let (text, kept) = without_links_outwards(page, |file| file == "a.html");
        let wanted =
            r##"<p><a href="a.html#x">a</a>, b <code>c</code>, <a href="#d">d</a>, <a href="https://e.org">e</a></p>"##;
        assert_eq!((text.as_str(), kept), (wanted, 2));
    }

    #[test]
    fn only_what_is_loaded_counts_as_from_elsewhere() {
        assert!(loads_from_elsewhere(r#"<p><link rel="stylesheet" href="https://fonts.example/a.css"></p>"#));
        assert!(loads_from_elsewhere(r#"<script src="http://example.org/a.js"></script>"#));
        assert!(!loads_from_elsewhere(r#"<a href="https://example.org">a</a><script src="a.js"></script>"#));
    }

    #[test]
    fn the_book_has_every_document() {
        let summary = workspace::read("docs/SUMMARY.md".as_ref()).unwrap();
        let documents = workspace::files_with("md").unwrap();
        let missing = documents
            .iter()
            .filter_map(|file| file.strip_prefix("docs").ok())
            .filter(|file| !file.ends_with("SUMMARY.md") && !summary.contains(&format!("({})", file.display())));
        assert_eq!(missing.collect::<Vec<_>>(), Vec::<&std::path::Path>::new());
    }
}
