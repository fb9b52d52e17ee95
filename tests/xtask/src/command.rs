//! Child processes: started in the project's root, output streamed through or captured as text.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader, ErrorKind};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};

use anyhow::{Context, Result, bail};

use crate::workspace;

/// A command about to be run in the project's root, without standard input.
pub(crate) struct Run {
    command: Command,
}

impl Run {
    pub(crate) fn new(program: &str) -> Self {
        let mut command = Command::new(program);
        command.current_dir(workspace::root()).stdin(Stdio::null());
        Self { command }
    }

    /// The cargo that runs this program.
    pub(crate) fn cargo() -> Self {
        Self::new(&std::env::var("CARGO").unwrap_or_else(|_| "cargo".into()))
    }

    pub(crate) fn args<A: AsRef<OsStr>>(mut self, arguments: impl IntoIterator<Item = A>) -> Self {
        self.command.args(arguments);
        self
    }

    pub(crate) fn env(mut self, name: &str, value: &str) -> Self {
        self.command.env(name, value);
        self
    }

    /// In another folder than the project's root.
    pub(crate) fn within(mut self, folder: &Path) -> Self {
        self.command.current_dir(folder);
        self
    }

    /// With the standard input of this program.
    pub(crate) fn interactive(mut self) -> Self {
        self.command.stdin(Stdio::inherit());
        self
    }

    /// Streams the output through; an error unless the command succeeds.
    pub(crate) fn stream(mut self) -> Result<()> {
        let shown = self.shown();
        println!("$ {shown}");
        let status = self.command.status().with_context(|| format!("cannot start `{shown}`"))?;
        if !status.success() {
            bail!("`{shown}` failed: {status}");
        }
        Ok(())
    }

    /// Streams the output through; the exit code, or `None` after a signal.
    pub(crate) fn code(mut self) -> Result<Option<i32>> {
        let shown = self.shown();
        println!("$ {shown}");
        let status = self.command.status().with_context(|| format!("cannot start `{shown}`"))?;
        Ok(status.code())
    }

    /// The exit code, and standard output as text; errors stream through.
    pub(crate) fn output(mut self) -> Result<(Option<i32>, String)> {
        let shown = self.shown();
        println!("$ {shown}");
        self.command.stderr(Stdio::inherit());
        let output = self.command.output().with_context(|| format!("cannot start `{shown}`"))?;
        Ok((output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned()))
    }

    /// Standard output as text; an error, with the standard error in it, unless the command succeeds.
    pub(crate) fn text(self) -> Result<String> {
        let shown = self.shown();
        let (success, output, errors) = self.captured()?;
        if !success {
            bail!("`{shown}` failed: {}", errors.trim());
        }
        Ok(output)
    }

    /// Standard output and standard error as one text, in the order in which they were written; each line is `reported` at once.
    pub(crate) fn merged(mut self, reported: impl Fn(&str)) -> Result<String> {
        let shown = self.shown();
        let (reader, writer) = std::io::pipe()?;
        let mut reader = BufReader::new(reader);
        self.command.stdout(writer.try_clone()?).stderr(writer);
        let mut child = self.command.spawn().with_context(|| format!("cannot start `{shown}`"))?;
        // The ends that this process would write to, without which the text has no end.
        drop(self);
        let (mut output, mut line) = (String::new(), Vec::new());
        while reader.read_until(b'\n', &mut line)? > 0 {
            let text = String::from_utf8_lossy(&line);
            reported(&text);
            output.push_str(&text);
            line.clear();
        }
        child.wait()?;
        Ok(output)
    }

    /// Starts it as the first of a group of processes; its standard output comes with it.
    pub(crate) fn started(mut self) -> Result<(Child, BufReader<ChildStdout>)> {
        let shown = self.shown();
        let started = self.command.process_group(0).stdout(Stdio::piped()).spawn();
        let mut child = started.with_context(|| format!("cannot start `{shown}`"))?;
        let output = child.stdout.take().context("standard output was piped")?;
        Ok((child, BufReader::new(output)))
    }

    /// Whether it succeeded, its standard output and its standard error.
    pub(crate) fn captured(mut self) -> Result<(bool, String, String)> {
        let output = self.command.output().with_context(|| format!("cannot start `{}`", self.shown()))?;
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        Ok((output.status.success(), text(&output.stdout), text(&output.stderr)))
    }

    /// The command as typed in a shell.
    fn shown(&self) -> String {
        let program = Path::new(self.command.get_program());
        let program = program.file_name().unwrap_or(program.as_os_str());
        let words = std::iter::once(program).chain(self.command.get_args());
        words.map(|word| word.to_string_lossy()).collect::<Vec<_>>().join(" ")
    }
}

/// Whether `program` can be started at all.
pub(crate) fn exists(program: &str) -> bool {
    let started = Command::new(program).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    !matches!(started, Err(error) if error.kind() == ErrorKind::NotFound)
}
