//! The file of a unit's claims, in the form of key files: nothing in it is secret, but it is written and checked as they are.

use std::fmt::Write;
use std::path::Path;

use cara_core::distribution::authenticator::CODE_BYTES;
use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::identity::Identity;
use cara_secure::keys::FINGERPRINT_BYTES;

use super::text::{FORM, FormError, Line, Lines, push_identity, push_sum};
use super::{KeyError, file};

/// The first line's word.
const HEAD: &str = "cara-claims";
/// Before a line that versions without hand-over have to skip: they skip what begins with `#`, and take a file with a word that
/// they do not know for damaged.
const LATER: &str = "#!";

/// What a unit keeps.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct KeptClaims {
    /// Of an m_unit: its own, or the highest one that it has heard where it did not start.
    pub(crate) own: Claim,
    /// The highest of each manager that it has obeyed.
    pub(crate) obeyed: Vec<KeptObeyed>,
    /// Of a vehicle that was handed over.
    pub(crate) handed: Option<KeptHandOver>,
}

/// The manager that a vehicle was handed over to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct KeptHandOver {
    /// The one that it was configured with: with another one this does not count.
    pub(crate) home: Identity,
    pub(crate) present: Identity,
}

/// A claim that a vehicle has obeyed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct KeptObeyed {
    pub(crate) manager: Identity,
    pub(crate) tagged: TaggedClaim,
    /// The fingerprint of the pair key: with other keys it does not count.
    pub(crate) key: [u8; FINGERPRINT_BYTES],
}

/// The claims in a file; `None` where there is none.
pub(crate) fn read_claims(path: &Path) -> Result<Option<KeptClaims>, KeyError> {
    if !file::is_there(path)? {
        return Ok(None);
    }
    let (text, _) = file::read(path)?;
    parse(&text).map(Some).map_err(|error| file::form(path, error))
}

pub(super) fn parse(text: &str) -> Result<KeptClaims, FormError> {
    let text = text.replace(&format!("\n{LATER}"), "\n");
    let mut lines = Lines::of(&text);
    lines.head(HEAD, "a file with claims begins with `cara-claims`")?;
    let (own, _) = claim(lines.expect("own", "here `own` is expected")?)?;
    let mut kept = KeptClaims { own, ..KeptClaims::default() };
    let mut home = None;
    for line in lines {
        match line.word {
            "obeyed" => kept.obeyed.push(parse_obeyed(line)?),
            "home" => home = Some(line.identity()?),
            "present" => {
                let present = line.identity()?;
                kept.handed = home.take().map(|home| KeptHandOver { home, present });
            }
            // Of a newer version: what is known counts all the same.
            _ => {}
        }
    }
    Ok(kept)
}

fn claim(line: Line<'_>) -> Result<(Claim, Line<'_>), FormError> {
    let wrong = line.wrong("here a term and a claimant, numbers of 64 bits, are expected");
    let (term, rest) = line.value();
    let (claimant, rest) = rest.value();
    match (term.parse(), claimant.parse()) {
        (Ok(term), Ok(claimant)) => Ok((Claim { term, claimant }, rest)),
        _ => Err(wrong),
    }
}

fn parse_obeyed(line: Line<'_>) -> Result<KeptObeyed, FormError> {
    let (claim, rest) = claim(line)?;
    let (tag_digits, rest) = rest.value();
    let (key_digits, rest) = rest.value();
    let (mut tag, mut key) = ([0; CODE_BYTES], [0; FINGERPRINT_BYTES]);
    hex::decode_to_slice(tag_digits, &mut tag).map_err(|_| line.wrong("here a tag of 32 digits is expected"))?;
    hex::decode_to_slice(key_digits, &mut key).map_err(|_| line.wrong("here a fingerprint is expected"))?;
    Ok(KeptObeyed { manager: rest.identity()?, tagged: TaggedClaim { claim, tag }, key })
}

fn digits(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Writes it, whole, and with its folder on the disk before this returns.
pub(crate) fn write_claims(path: &Path, kept: &KeptClaims) -> Result<(), KeyError> {
    if let Some(folder) = path.parent() {
        file::make_folder(folder)?;
    }
    file::write_private(path, text(kept).as_bytes())
}

/// The text of its file.
pub(super) fn text(kept: &KeptClaims) -> String {
    let mut text = String::new();
    // Writing to text does not fail.
    let _ = writeln!(text, "{HEAD} {FORM}\nown {} {}", kept.own.term, kept.own.claimant);
    for KeptObeyed { manager, tagged, key } in &kept.obeyed {
        let Claim { term, claimant } = tagged.claim;
        let _ = write!(text, "obeyed {term} {claimant} {} {} ", digits(&tagged.tag), digits(key));
        push_identity(&mut text, manager);
        text.push('\n');
    }
    if let Some(KeptHandOver { home, present }) = &kept.handed {
        for (word, manager) in [("home ", home), ("present ", present)] {
            text.push_str(LATER);
            text.push_str(word);
            push_identity(&mut text, manager);
            text.push('\n');
        }
    }
    push_sum(&mut text);
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept() -> KeptClaims {
        KeptClaims { own: Claim { term: 3, claimant: 4 }, ..KeptClaims::default() }
    }

    #[test]
    fn what_a_newer_version_adds_is_skipped() {
        let mut text = format!("{HEAD} {FORM}\nown 3 4\nlater 5 six\n#!later\n");
        push_sum(&mut text);
        assert_eq!(parse(&text).unwrap(), kept());
    }

    #[test]
    fn a_hand_over_is_a_comment_for_versions_without() {
        let (home, present) = (Identity::m_unit("depot", 1).unwrap(), Identity::m_unit("the yard", 3).unwrap());
        let handed = KeptClaims { handed: Some(KeptHandOver { home, present }), ..kept() };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("agv.claims");
        write_claims(&path, &handed).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        // What those versions read.
        let words: Vec<&str> = Lines::of(&text).map(|line| line.word).collect();
        assert_eq!(words, [HEAD, "own"]);
        // As versions wrote it before.
        let mut before = text.replace(LATER, "");
        before.truncate(before.rfind("sum ").unwrap());
        push_sum(&mut before);
        assert!(before.contains("\nhome "));
        assert_eq!([parse(&text).unwrap(), parse(&before).unwrap()], [handed.clone(), handed]);
    }
}
