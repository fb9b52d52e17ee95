//! `cara web`: the page of the crate `cara-web`, with the m_unit that the options choose.

use std::ops::ControlFlow;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cara_std::control::protocol::{Answer, Question};
use cara_web::{Beat, Cancel, Connection, Unit};
use serde_json::Value;

use super::logs::{Decoding, FirmwareArguments, Logs};
use crate::commands::scan::all_managers;
use crate::operator::{Need, Operator};
use cara_tools::exit::Ended;
use cara_tools::global::Global;

#[derive(clap::Args)]
#[group(skip)]
pub(crate) struct Arguments {
    #[command(flatten)]
    page: cara_web::Arguments,
    #[command(flatten)]
    firmware: FirmwareArguments,
}

pub(crate) fn run(Arguments { page, firmware }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let decoding = Arc::new(Decoding::of(&firmware, Decoding::OfLinux)?);
    // A manager that is not there now may come, and the page says that it is absent. What is ambiguous is told now.
    let own = match &global.act_as {
        Some(_) => Some(Operator::open(global, &Need::Nothing)?),
        None => {
            Operator::open_if_any(global, &Need::Nothing)?;
            None
        }
    };
    cara_web::run(page, Arc::new(Chosen { global: global.clone(), own, decoding }), global)
}

/// The unit that the options choose.
struct Chosen {
    global: Global,
    /// That of this process.
    own: Option<Operator>,
    decoding: Arc<Decoding>,
}

impl Unit for Chosen {
    fn connect(&self, for_a_stop: bool) -> anyhow::Result<Box<dyn Connection>> {
        let operator = match &self.own {
            Some(own) => own.another()?,
            None if for_a_stop => Operator::open_to_stop(&self.global, &Need::Nothing)?,
            None => Operator::open(&self.global, &Need::Nothing)?,
        };
        Ok(Box::new(Way { operator, wanted: Arc::new(AtomicBool::new(true)), beaten: Arc::default() }))
    }

    fn findings(&self, listen: Duration) -> anyhow::Result<Value> {
        if self.own.is_some() {
            return Err(Ended::usage(
                "the doctor asks units that run, and this one is of `cara web --as`: start `cara doctor`",
            ));
        }
        cara_doctor::examine(listen, &self.global)
    }

    fn logs(&self) -> cara_web::Logs {
        let mut logs = Logs::new(self.decoding.clone());
        Box::new(move |answer| logs.events(answer))
    }

    fn managers(&self, listen: Duration) -> anyhow::Result<Value> {
        if self.own.is_some() {
            return Err(Ended::usage(
                "this asks units that run, and this one is of `cara web --as`: start `cara scan --all-managers`",
            ));
        }
        all_managers::for_page(listen, &self.global)
    }
}

struct Way {
    operator: Operator,
    wanted: Arc<AtomicBool>,
    /// When a page last said that it is there, for a hold of the unit in this process.
    beaten: Arc<Mutex<Option<Instant>>>,
}

impl Way {
    fn beaten(beaten: &Mutex<Option<Instant>>) -> MutexGuard<'_, Option<Instant>> {
        beaten.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Connection for Way {
    fn ask(&mut self, question: &Question, each: &mut dyn FnMut(Answer) -> ControlFlow<()>) -> anyhow::Result<()> {
        let (wanted, beaten) = (&self.wanted, &self.beaten);
        let last = || Self::beaten(beaten).unwrap_or_else(Instant::now);
        self.operator.pass_on(question, each, &|| wanted.load(Ordering::Acquire).then(last))
    }

    fn beats(&mut self) -> anyhow::Result<Beat> {
        let (beater, beaten) = (self.operator.beater()?, self.beaten.clone());
        *Self::beaten(&beaten) = Some(Instant::now());
        Ok(Box::new(move || {
            *Self::beaten(&beaten) = Some(Instant::now());
            beater.iter().for_each(cara_std::control::Closer::beat);
        }))
    }

    fn cancel(&self) -> anyhow::Result<Cancel> {
        let (wanted, closer) = (self.wanted.clone(), self.operator.closer()?);
        Ok(Box::new(move || {
            wanted.store(false, Ordering::Release);
            closer.iter().for_each(cara_std::control::Closer::close);
        }))
    }
}
