//! Peers written in C++: a shared library that `native/peer.h` describes, loaded and measured by this program.
//!
//! The first argument is the library; the others are those of every peer.

use std::ffi::{CStr, CString, c_char, c_int, c_long, c_void};
use std::sync::{Arc, OnceLock};

use anyhow::{Context, Result, bail, ensure};
use cara_bench_ends::{Caller, Delivery, Executed, Peer, Place, Server};
use libloading::Library;

/// Counts what the library's one-way service takes.
static EXECUTED: OnceLock<Arc<Executed>> = OnceLock::new();

extern "C" fn note() {
    if let Some(executed) = EXECUTED.get() {
        executed.note();
    }
}

/// The functions of `native/peer.h`.
#[derive(Clone, Copy)]
struct Functions {
    serve: unsafe extern "C" fn(u32, extern "C" fn()) -> *const c_char,
    connect: unsafe extern "C" fn(u32, *const c_char) -> *mut c_void,
    echo: unsafe extern "C" fn(*mut c_void, *const c_char, usize) -> c_long,
    send: unsafe extern "C" fn(*mut c_void, *const c_char, usize) -> c_int,
    error: unsafe extern "C" fn() -> *const c_char,
}

impl Functions {
    fn load(path: &str) -> Result<Self> {
        // SAFETY: the library is one of this folder's; it stays loaded until the process ends.
        let library: &Library = unsafe { Box::leak(Box::new(Library::new(path)?)) };
        macro_rules! function {
            ($name:literal) => {
                // SAFETY: the type is that of the declaration in native/peer.h.
                *unsafe { library.get($name) }.context("the library is not one of the peers")?
            };
        }
        Ok(Self {
            serve: function!(b"peer_serve"),
            connect: function!(b"peer_connect"),
            echo: function!(b"peer_echo"),
            send: function!(b"peer_send"),
            error: function!(b"peer_error"),
        })
    }

    /// Why the last call of this thread failed.
    fn error(&self) -> String {
        // SAFETY: a text that is valid until this thread's next call.
        unsafe { CStr::from_ptr((self.error)()) }.to_string_lossy().into_owned()
    }
}

impl Peer for Functions {
    fn start_server(&self, place: &Place) -> Result<Server> {
        let executed = EXECUTED.get_or_init(Arc::default).clone();
        // SAFETY: called once, before any other.
        let address = unsafe { (self.serve)(place.run, note) };
        if address.is_null() {
            bail!(self.error());
        }
        // SAFETY: not null, and valid as long as the library.
        let address = unsafe { CStr::from_ptr(address) }.to_str()?.to_owned();
        Ok(Server::new(address, executed, ()))
    }

    fn connect(&self, place: &Place, address: &str) -> Result<Box<dyn Caller>> {
        let address = CString::new(address)?;
        // SAFETY: the address lives during the call; the library locks what its callers share.
        let caller = unsafe { (self.connect)(place.run, address.as_ptr()) };
        ensure!(!caller.is_null(), self.error());
        Ok(Box::new(Calls { functions: *self, caller, text: CString::default() }))
    }
}

struct Calls {
    functions: Functions,
    caller: *mut c_void,
    /// The last text as C has it: a program in C++ would have no other.
    text: CString,
}

// SAFETY: a caller belongs to one thread at a time, which is all that native/peer.h asks for.
unsafe impl Send for Calls {}

impl Calls {
    fn keep(&mut self, text: &str) -> Result<()> {
        if self.text.as_bytes() != text.as_bytes() {
            self.text = CString::new(text)?;
        }
        Ok(())
    }
}

impl Caller for Calls {
    fn echo(&mut self, text: &str) -> Result<usize> {
        self.keep(text)?;
        // SAFETY: the caller comes from peer_connect; the text ends with a zero behind its length.
        let length = unsafe { (self.functions.echo)(self.caller, self.text.as_ptr(), text.len()) };
        usize::try_from(length).map_err(|_| anyhow::Error::msg(self.functions.error()))
    }

    fn send(&mut self, text: &str, _: Delivery) -> Result<(), String> {
        self.keep(text).map_err(|error| error.to_string())?;
        // SAFETY: as above.
        match unsafe { (self.functions.send)(self.caller, self.text.as_ptr(), text.len()) } {
            0 => Ok(()),
            _ => Err(self.functions.error()),
        }
    }
}

fn main() -> Result<()> {
    let mut arguments: Vec<String> = std::env::args().collect();
    ensure!(arguments.len() > 1, "which library?");
    let library = arguments.remove(1);
    cara_bench_ends::main_with(&Functions::load(&library)?, &arguments)
}
