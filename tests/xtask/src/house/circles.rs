//! Circles of imports: files of a crate of which each leads to each other.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::{CRATES, Figure, File};
use crate::layers::{module_of, resolve};
use crate::source;

/// For each crate how many files are in its largest circle.
pub(super) fn figures(product: &[File]) -> Vec<Figure> {
    let largest = |folder: &str| {
        let files: Vec<_> = product.iter().filter(|file| file.is_below(folder)).collect();
        circles(&imports(&files, folder)).iter().map(BTreeSet::len).max().unwrap_or_default()
    };
    let how = "files of which each imports each other, on whatever way; the largest such set. lib.rs is none of them";
    let figure = |(name, folder): &(&str, &str)| Figure {
        name: format!("circle of imports in {name}"),
        value: largest(folder),
        how,
    };
    CRATES.iter().map(figure).collect()
}

/// For each file of a crate, by its module, which others it names.
fn imports(files: &[&File], folder: &str) -> BTreeMap<Vec<String>, BTreeSet<Vec<String>>> {
    let module = |file: &File| module_of(file.path.strip_prefix(folder).unwrap_or(Path::new("")));
    let all: BTreeSet<_> = files.iter().map(|file| module(file)).collect();
    let named = |file: &&File| {
        let (own, tokens) = (module(file), file.tokens());
        let paths = source::paths(&tokens);
        let targets = paths.iter().filter_map(|path| resolve(&own, &path.segments));
        let targets = targets.filter_map(|target| {
            (1..=target.len()).rev().map(|end| target[..end].to_vec()).find(|module| all.contains(module))
        });
        (own.clone(), targets.filter(|target| *target != own).collect())
    };
    files.iter().filter(|file| !module(file).is_empty()).map(named).collect()
}

/// The strongly connected sets of more than one node.
fn circles<N: Ord + Clone>(arrows: &BTreeMap<N, BTreeSet<N>>) -> Vec<BTreeSet<N>> {
    let reached = |from: &N| {
        let (mut seen, mut left) = (BTreeSet::new(), vec![from]);
        while let Some(targets) = left.pop().and_then(|node| arrows.get(node)) {
            left.extend(targets.iter().filter(|target| seen.insert((*target).clone())));
        }
        seen
    };
    let reached: BTreeMap<&N, BTreeSet<N>> = arrows.keys().map(|node| (node, reached(node))).collect();
    let circle = |node: &N| {
        let others = reached[node].iter().filter(|other| reached.get(other).is_some_and(|back| back.contains(node)));
        others.cloned().collect::<BTreeSet<N>>()
    };
    let mut found: Vec<_> = arrows.keys().map(circle).filter(|circle| circle.len() > 1).collect();
    found.sort();
    found.dedup();
    found
}

#[cfg(test)]
mod tests {
    use super::circles;
    use std::collections::{BTreeMap, BTreeSet};

    #[test]
    fn a_way_back_makes_a_circle() {
        let arrows = |pairs: &[(u8, &[u8])]| -> BTreeMap<u8, BTreeSet<u8>> {
            pairs.iter().map(|(from, to)| (*from, to.iter().copied().collect())).collect()
        };
        assert!(circles(&arrows(&[(1, &[2, 3]), (2, &[3]), (3, &[])])).is_empty());
        let found = circles(&arrows(&[(1, &[2]), (2, &[3]), (3, &[1]), (4, &[1])]));
        assert_eq!(found, [BTreeSet::from([1, 2, 3])]);
    }
}
