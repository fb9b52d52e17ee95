//! Attacks on the links of a unit, in both directions of dialling.

use std::io;
use std::time::Instant;

use anyhow::Result;
use cara_core::config::{Mode, Priority};
use cara_core::distribution::identity::Fleet;
use cara_core::host::frame::{self, Frame};
use cara_secure::keys::PairKey;

use crate::ground::Keys;
use crate::speaker::{Claim, End, HANDSHAKE, PATIENCE, STEPS, Said, Speaker, framed, request_in_clear};
use crate::tally::Report;
use crate::target::{Target, Visit};
use crate::trial::{attack, control, row};

/// Lengths of frames that no unit takes before the proof.
const TOO_LONG: [usize; 6] = [318, 319, 320, 1_024, 4_096, 65_535];
/// Tries of a frame that ends its link: on a busy machine the unit's wait may be over before the frame is there.
const TRIES: usize = 3;

/// How much is tried.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extent {
    /// Everything.
    Full,
    /// Some of everything.
    Quick,
}

impl Extent {
    /// Some of many cases: all of them, or one in `of`.
    pub fn some<C>(self, cases: Vec<C>, of: usize) -> Vec<C> {
        match self {
            Self::Full => cases,
            Self::Quick => cases.into_iter().step_by(of).collect(),
        }
    }
}

/// All attacks on links.
pub fn run(report: &mut Report, target: &dyn Target, extent: Extent) -> Result<()> {
    with_the_key(report, target)?;
    keys(report, target, extent)?;
    without_a_key(report, target, extent)?;
    plain(report, target, extent)?;
    lengths(report, target, extent)?;
    replays(report, target, extent, Mode::Secured)
}

/// All replays, in the mode of the target.
pub fn replays(report: &mut Report, target: &dyn Target, extent: Extent, mode: Mode) -> Result<()> {
    let record = record(target, mode)?;
    recorded_elsewhere(report, target, extent, mode, &record)?;
    recorded_here(report, target, extent, mode)?;
    whole_records(report, target, mode, &record)
}

/// As many cases as the target has time for, evenly from all of them.
fn share<C>(target: &dyn Target, cases: Vec<C>) -> Vec<C> {
    let wanted = target.share(cases.len()).clamp(1, cases.len().max(1));
    let of = cases.len().div_ceil(wanted).max(1);
    cases.into_iter().step_by(of).collect()
}

/// The same attacker with the key gets in, which shows that successes are counted.
pub fn with_the_key(report: &mut Report, target: &dyn Target) -> Result<()> {
    control(report, target, "the same attacker with the key", &share(target, vec![(); 8]), |(), visit| {
        let mut speaker = visit.speaker(&visit.keys.genuine)?;
        speaker.converse(HANDSHAKE + 1)?;
        // Requests of one class run in order: once this one is answered, the one before it has run as well.
        let request = speaker.request(0, Priority::Normal, true);
        speaker.say_bytes(&request)?;
        speaker.hear_answer(speaker.last_id())?;
        let asked = speaker.asked.clone();
        speaker.finish();
        let end = Instant::now() + PATIENCE;
        loop {
            let seen = (visit.seen)()?;
            let served = !target.reports_calls() || asked.iter().all(|mark| seen.marks.contains(mark));
            if (seen.joins == 1 && served) || Instant::now() > end {
                return Ok(seen.joins == 1 && served);
            }
        }
    })
}

/// Selects the key that is tried.
type Which = fn(&Keys) -> &PairKey;

fn keys(report: &mut Report, target: &dyn Target, extent: Extent) -> Result<()> {
    let tried: [(&str, Which); 4] = [
        ("wrong key", |keys| &keys.wrong),
        ("key of another fleet", |keys| &keys.of_another_fleet),
        ("key of before the change of keys", |keys| &keys.revoked),
        ("key of another unit of the fleet", |keys| &keys.of_another_unit),
    ];
    for (name, which) in tried {
        let cases = share(target, extent.some((0..120_u32).collect(), 4));
        attack(report, target, name, &cases, |number, visit| {
            let mut claim = visit.claim.clone();
            // Every second attempt with another fleet's key also claims that fleet.
            if name.ends_with("another fleet") && number % 2 == 1 {
                claim.fleet = Fleet(claim.fleet.0.wrapping_add(1));
            }
            let mut speaker = visit.speaker_as(Mode::Secured, claim, which(&visit.keys))?;
            let _ = speaker.converse(STEPS);
            visit.was_seen(speaker)
        })?;
    }
    Ok(())
}

/// What an attacker without a key sends.
#[derive(Clone, Copy, Debug)]
enum Ruse {
    RandomProof,
    ZeroKey,
    ConfirmInClear,
    RequestInClear,
    RequestAtOnce,
    HelloTwice,
    Reflect,
    AnyFrame,
    Noise,
}

const RUSES: [Ruse; 9] = [
    Ruse::RandomProof,
    Ruse::ZeroKey,
    Ruse::ConfirmInClear,
    Ruse::RequestInClear,
    Ruse::RequestAtOnce,
    Ruse::HelloTwice,
    Ruse::Reflect,
    Ruse::AnyFrame,
    Ruse::Noise,
];

fn without_a_key(report: &mut Report, target: &dyn Target, extent: Extent) -> Result<()> {
    let cases: Vec<Ruse> = RUSES.iter().copied().cycle().take(RUSES.len() * 24).collect();
    // All of them are tried in any case.
    let some = share(target, extent.some((0..cases.len()).collect(), 3)).len().max(RUSES.len());
    let cases: Vec<Ruse> = cases.into_iter().take(some).collect();
    attack(report, target, "no key", &cases, |ruse, visit| {
        let key = if matches!(ruse, Ruse::ZeroKey) { PairKey::new([0; 32]) } else { visit.keys.wrong.clone() };
        let mut speaker = visit.speaker(&key)?;
        let _ = pretend(*ruse, &visit, &mut speaker);
        visit.was_seen(speaker)
    })
}

fn noise(length: usize) -> Vec<u8> {
    std::iter::repeat_with(|| fastrand::u8(..)).take(length).collect()
}

/// Bytes as the body of a frame.
pub(crate) fn in_frame(body: &[u8]) -> Vec<u8> {
    [&(body.len() as u16).to_le_bytes()[..], body].concat()
}

fn pretend(ruse: Ruse, visit: &Visit<'_>, speaker: &mut Speaker) -> io::Result<()> {
    match ruse {
        Ruse::RequestAtOnce => return speaker.say_bytes(&request_in_clear()),
        Ruse::Noise => return speaker.say_bytes(&noise(600)),
        Ruse::ZeroKey => return speaker.converse(STEPS).map(drop),
        _ => drop(speaker.converse(1)?),
    }
    let proof = || [&[7][..], &noise(48)].concat();
    match ruse {
        Ruse::RandomProof => {
            speaker.say_bytes(&in_frame(&proof()))?;
            (0..3).try_for_each(|_| speaker.say_bytes(&in_frame(&noise(50))))
        }
        Ruse::ConfirmInClear => {
            speaker.say_bytes(&framed(&Frame::Confirm(&noise(33))))?;
            speaker.say_bytes(&request_in_clear())
        }
        Ruse::RequestInClear => speaker.say_bytes(&request_in_clear()),
        Ruse::HelloTwice => {
            let claim = Claim { fleet: visit.claim.fleet, ..visit.claim.clone() };
            let again = crate::speaker::hello(&claim, Mode::Secured, 9);
            speaker.say_bytes(&framed(&Frame::Hello(&again)))?;
            speaker.say_bytes(&request_in_clear())
        }
        Ruse::Reflect => {
            // As the dialling end, it receives the other hello only now.
            let _ = speaker.step();
            let heard = speaker.heard.clone();
            heard.iter().try_for_each(|frame| speaker.say_bytes(frame))
        }
        _ => speaker.say_bytes(&in_frame(&[&[fastrand::u8(..)][..], &noise(fastrand::usize(..60))].concat())),
    }
}

/// An attacker in plain mode, or one that continues in plain text after a secured hello.
pub fn plain(report: &mut Report, target: &dyn Target, extent: Extent) -> Result<()> {
    let cases = share(target, extent.some((0..60_u32).collect(), 3));
    attack(report, target, "downgrade to plain", &cases, |_, visit| {
        let mut speaker = visit.speaker_as(Mode::Plain, visit.claim.clone(), &visit.keys.wrong)?;
        let _ = speaker.converse(STEPS);
        visit.was_seen(speaker)
    })
}

/// Whether a target accepts a frame that has to end its link. `once` sends it, and returns whether the application saw
/// anything of it and how the link ended while the attacker kept its own end open.
fn passes(once: impl Fn() -> Result<(bool, End)>) -> Result<bool> {
    for _ in 0..TRIES {
        let (seen, end) = once()?;
        if seen || end.blames_what_came() {
            return Ok(seen);
        }
    }
    Ok(true)
}

/// Whether `bytes` is a complete frame by its own length prefix. The target waits for the rest of an incomplete one.
fn is_whole(bytes: &[u8]) -> bool {
    frame::first_frame_length(bytes).is_some_and(|length| length <= bytes.len())
}

/// A step of the handshake and what is said instead of it.
fn cut_and_long(steps: &[Said]) -> Vec<(usize, Vec<u8>)> {
    let mut cases = Vec::new();
    for (at, said) in steps.iter().enumerate() {
        let body = said.bytes.get(2..).unwrap_or_default();
        cases.extend((0..body.len()).map(|length| (at, in_frame(body.get(..length).unwrap_or_default()))));
        cases.extend((0..said.bytes.len()).map(|length| (at, said.bytes.get(..length).unwrap_or_default().to_vec())));
        cases.extend(TOO_LONG.map(|length| (at, in_frame(&vec![0x13; length]))));
        cases.extend(TOO_LONG.map(|length| (at, in_frame(&[body, &vec![0; length - body.len()]].concat()))));
    }
    cases
}

fn lengths(report: &mut Report, target: &dyn Target, extent: Extent) -> Result<()> {
    let record = record(target, Mode::Secured)?;
    let cases = cut_and_long(record.said.get(..HANDSHAKE).unwrap_or_default());
    let cases = share(target, extent.some(cases, 9));
    row(report, target, "truncated and oversize frames before the proof", &cases, false, |(at, instead)| {
        if is_whole(instead) {
            return passes(|| {
                let (visit, mut speaker) = instead_of(target, *at, instead)?;
                let end = speaker.hear_end();
                Ok((visit.was_seen(speaker)?, end))
            });
        }
        // It ends with the attacker's end of the connection.
        let (visit, speaker) = instead_of(target, *at, instead)?;
        visit.was_seen(speaker)
    })?;
    sealed_lengths(report, target, extent)
}

/// The genuine handshake up to a step, and `instead` in place of that step, so that only these bytes are wrong.
fn instead_of<'t>(target: &'t dyn Target, at: usize, instead: &[u8]) -> Result<(Visit<'t>, Speaker)> {
    let visit = target.visit()?;
    let mut speaker = visit.speaker(&visit.keys.genuine)?;
    let _ = speaker.converse(at).and_then(|_| speaker.step()).and_then(|_| speaker.say_bytes(instead));
    Ok((visit, speaker))
}

fn sealed_lengths(report: &mut Report, target: &dyn Target, extent: Extent) -> Result<()> {
    let lengths = [0, 1, 15, 16, 17, 40, 57, 1_025, 1_200, 4_200, 65_535];
    let cases: Vec<_> = (4..STEPS).flat_map(|at| lengths.map(|length| (at, length))).collect();
    let cases = share(target, extent.some(cases, 3));
    row(report, target, "truncated and oversize sealed frames", &cases, false, |(at, length)| {
        passes(|| sealed_of_length(&target.visit()?, *at, *length))
    })
}

/// A sealed frame of a wrong length after so many steps, and the others behind it.
fn sealed_of_length(visit: &Visit<'_>, at: usize, length: usize) -> Result<(bool, End)> {
    let mut speaker = visit.speaker(&visit.keys.genuine)?;
    let _ = speaker.converse(at);
    let asked = speaker.asked.clone();
    let next = speaker.request(0, Priority::Normal, false);
    let mut body = next.get(2..).unwrap_or_default().to_vec();
    // At the genuine length the frame would be valid: make it one byte longer.
    body.resize(if length == body.len() { length + 1 } else { length }, 0);
    let _ = speaker.say_bytes(&in_frame(&body));
    // A datagram may overtake the wrong frame; a request behind it in the stream must not run.
    while let Ok(Some(next)) = speaker.step() {
        if !next.datagram && speaker.say(&next).is_err() {
            break;
        }
    }
    let end = speaker.hear_end();
    Ok((visit.saw_more(speaker, 1, &asked)?, end))
}

/// A genuine conversation as recorded on the network.
pub struct Record {
    /// What the genuine peer said.
    pub said: Vec<Said>,
    /// What the target said.
    pub heard: Vec<Vec<u8>>,
}

/// Records a conversation between a genuine peer and the target.
pub fn record(target: &dyn Target, mode: Mode) -> Result<Record> {
    let visit = target.visit()?;
    let mut speaker = visit.speaker_as(mode, visit.claim.clone(), &visit.keys.genuine)?;
    let mut said = Vec::new();
    while let Some(next) = speaker.step()? {
        speaker.say(&next)?;
        said.push(next);
    }
    speaker.finish();
    Ok(Record { said, heard: speaker.heard })
}

impl Record {
    /// All of it as something to be said.
    fn all(&self) -> impl Iterator<Item = Said> + '_ {
        let heard = self.heard.iter().map(|bytes| Said { datagram: false, bytes: bytes.clone() });
        self.said.iter().cloned().chain(heard)
    }
}

/// A genuine conversation in which `again` is replayed after `state` steps; whether the target acted on it.
fn interrupted(visit: &Visit<'_>, mode: Mode, state: usize, again: impl Fn(&[Said]) -> Option<Said>) -> Result<bool> {
    let mut speaker = visit.speaker_as(mode, visit.claim.clone(), &visit.keys.genuine)?;
    let mut said = Vec::new();
    let mut joins = 1;
    for at in 0..=STEPS {
        if at == state
            && let Some(again) = again(&said)
        {
            if !again.datagram && state < HANDSHAKE {
                joins = 0;
            }
            let _ = speaker.say(&again);
            if again.datagram {
                // Read before what follows it in the stream.
                std::thread::sleep(std::time::Duration::from_millis(3));
            }
        }
        let Ok(Some(next)) = speaker.step() else { break };
        if speaker.say(&next).is_err() {
            break;
        }
        said.push(next);
    }
    let asked = speaker.asked.clone();
    visit.saw_more(speaker, joins, &asked)
}

fn recorded_elsewhere(
    report: &mut Report,
    target: &dyn Target,
    extent: Extent,
    mode: Mode,
    record: &Record,
) -> Result<()> {
    let cases: Vec<_> = (0..=STEPS).flat_map(|state| record.all().map(move |old| (state, old))).collect();
    let cases = share(target, extent.some(cases, 7));
    attack(report, target, "frames of another link, at every state", &cases, |(state, old), visit| {
        interrupted(&visit, mode, *state, |said| Some(moved(old, said)))
    })
}

/// A recorded datagram with the link and the nonce of this link, as far as it has shown them.
fn moved(old: &Said, said: &[Said]) -> Said {
    let mut moved = old.clone();
    let here = said.iter().rev().find(|said| said.datagram);
    if let (true, Some(here)) = (old.datagram, here) {
        moved.bytes.iter_mut().zip(&here.bytes).take(24).for_each(|(to, from)| *to = *from);
    }
    moved
}

fn recorded_here(report: &mut Report, target: &dyn Target, extent: Extent, mode: Mode) -> Result<()> {
    let cases: Vec<_> = (1..=STEPS).flat_map(|state| (0..state).map(move |old| (state, old))).collect();
    let cases = share(target, extent.some(cases, 3));
    attack(report, target, "frames of the same link, at every later state", &cases, |(state, old), visit| {
        interrupted(&visit, mode, *state, |said| said.get(*old).cloned())
    })
}

fn whole_records(report: &mut Report, target: &dyn Target, mode: Mode, record: &Record) -> Result<()> {
    let cases = share(target, (1..=record.said.len()).collect());
    attack(report, target, "whole recorded conversations", &cases, |length, visit| {
        let mut speaker = visit.speaker_as(mode, visit.claim.clone(), &visit.keys.wrong)?;
        for said in record.said.iter().take(*length) {
            if speaker.say(said).is_err() {
                break;
            }
        }
        visit.was_seen(speaker)
    })
}
