//! The owner of an instruction, from the debug information of an image: of all functions inlined at that place, the
//! innermost one that has an owner.

use std::cell::RefCell;
use std::collections::HashMap;
use std::path::Path;
use std::rc::Rc;

use addr2line::Loader;
use anyhow::{Result, anyhow};

/// The owner of code.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Owner {
    /// The core, the port and the service.
    Cara,
    /// smoltcp and embassy-net.
    Network,
    /// Driver of the Ethernet controller, clock, executor, timers.
    Board,
}

/// Parts of file names and their owners. Code without an owner, such as the standard library, counts for its caller.
const OWNERS: [(&str, Owner); 12] = [
    ("smoltcp-", Owner::Network),
    ("embassy-net-", Owner::Network),
    ("managed-", Owner::Network),
    ("embassy-executor", Owner::Board),
    ("embassy-time", Owner::Board),
    ("examples/firmware/emulated/", Owner::Board),
    ("examples/firmware/lm3s6965evb/", Owner::Board),
    ("cortex-m-rt", Owner::Board),
    ("core/src/", Owner::Cara),
    ("embassy-port/", Owner::Cara),
    ("examples/", Owner::Cara),
    ("tests/instructions/", Owner::Cara),
];

/// One instruction's.
#[derive(Clone, Debug)]
pub(crate) struct Place {
    /// `None` for code without an owner that was not inlined, such as `memcpy`: it counts for its caller.
    pub(crate) owner: Option<Owner>,
    /// The innermost function that has an owner, and the innermost of all.
    pub(crate) function: String,
    pub(crate) innermost: String,
    /// The function that everything was inlined into.
    pub(crate) symbol: String,
    /// It takes a frame from the controller.
    pub(crate) receives: bool,
    /// It waits for an interrupt.
    pub(crate) waits: bool,
}

/// Looks instructions up.
pub(crate) struct Places {
    loader: Loader,
    known: RefCell<HashMap<u32, Rc<Place>>>,
}

impl Places {
    pub(crate) fn of(image: &Path) -> Result<Self> {
        let loader = Loader::new(image).map_err(|error| anyhow!("{}: {error}", image.display()))?;
        Ok(Self { loader, known: RefCell::default() })
    }

    /// The place of an instruction.
    pub(crate) fn place(&self, address: u32) -> Rc<Place> {
        let mut known = self.known.borrow_mut();
        known.entry(address).or_insert_with(|| Rc::new(look_up(&self.loader, address))).clone()
    }
}

fn look_up(loader: &Loader, address: u32) -> Place {
    let mut frames = Vec::new();
    if let Ok(mut found) = loader.find_frames(address.into()) {
        while let Ok(Some(frame)) = found.next() {
            let file = frame.location.and_then(|location| location.file).unwrap_or_default().to_owned();
            let name = frame.function.and_then(|function| function.demangle().ok().map(|name| name.into_owned()));
            frames.push((name.unwrap_or_default(), file));
        }
    }
    let owned = frames.iter().find_map(|(name, file)| Some((name.clone(), owner(file)?)));
    let name = |frame: Option<&(String, String)>| frame.map(|(name, _)| name.clone()).unwrap_or_default();
    Place {
        owner: owned.as_ref().map(|(_, owner)| *owner),
        function: owned.map(|(function, _)| function).unwrap_or_else(|| name(frames.first())),
        innermost: name(frames.first()),
        symbol: name(frames.last()),
        receives: frames.iter().any(|(name, file)| name.contains("consume") && file.ends_with("ethernet.rs")),
        waits: frames.iter().any(|(name, _)| name.ends_with("wfi") || name.contains("asm::wfi")),
    }
}

/// Whose file it is.
fn owner(file: &str) -> Option<Owner> {
    if file.contains("/rustc/") || file.contains("/library/") {
        return None;
    }
    OWNERS.iter().find(|(part, _)| file.contains(part)).map(|(_, owner)| *owner)
}

#[cfg(test)]
mod tests {
    use super::{Owner, owner};

    #[test]
    fn files_have_owners() {
        assert_eq!(owner("./core/src/services/session/inbound.rs"), Some(Owner::Cara));
        assert_eq!(owner("cargo/registry/src/index/smoltcp-0.13.1/src/socket/tcp.rs"), Some(Owner::Network));
        assert_eq!(owner("./examples/firmware/lm3s6965evb/src/ethernet.rs"), Some(Owner::Board));
        assert_eq!(owner("/rustc/5980/library/core/src/slice/mod.rs"), None);
        assert_eq!(owner("cargo/registry/src/index/heapless-0.9.3/src/vec/mod.rs"), None);
    }
}
