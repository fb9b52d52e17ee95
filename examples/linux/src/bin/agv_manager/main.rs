//! The paper's listing (section 2): a manager finds an AGV, asks where it is, sends it somewhere, and offers it a
//! mechanic. Then it serves until Ctrl-C.

use std::process::ExitCode;
use std::thread::sleep;
use std::time::Duration;

use anyhow::Result;
use cara_apps::mechanic;
use cara_examples::{Network, Stop, ended, log_to_stderr, say};
use cara_std::{CommunicationSystem, Parameters, Renew};
use clap::Parser;

mod console;
mod transcript;

use transcript::Transcript;

/// A manager of AGVs.
#[derive(Parser)]
struct Options {
    #[arg(long, default_value = "AGV_manager")]
    name: String,
    #[arg(long, default_value_t = 1)]
    id: u32,
    /// Wait for a line on standard input behind each line of the listing, then take commands from there; `help` lists
    /// them.
    #[arg(long, conflicts_with = "attended")]
    console: bool,
    /// Start although a live manager has this one's name and id: it steps down, and its AGVs come to this one.
    #[arg(long)]
    take_over: bool,
    #[command(flatten)]
    network: Network,
}

fn main() -> Result<ExitCode> {
    ended(run())
}

fn run() -> Result<()> {
    let options = Options::parse();
    log_to_stderr();
    let stop = Stop::new(options.network.attended)?;
    let transcript = Transcript::new(options.console);
    let (work, stopper) = (transcript.clone(), stop.stopper());
    // On a thread of its own, so that a signal ends the program wherever the listing is.
    std::thread::spawn(move || match listing(&options, &work) {
        Ok(agv_manager) if options.console => stopper.stop(console::run(&agv_manager)),
        Ok(_) => {}
        Err(error) => stopper.stop(Err(error)),
    });
    let outcome = stop.wait();
    transcript.stop_unit();
    outcome?;
    say!("ended");
    Ok(())
}

/// Comments are line numbers of the paper's listing. Behind each line, `transcript` says what came of it.
fn listing(options: &Options, transcript: &Transcript) -> Result<CommunicationSystem> {
    let Options { name, id, take_over, network, .. } = options;
    // README begins.
    let agv_manager = network.place(CommunicationSystem::builder(name, *id)?.take_over(*take_over)).build()?; // 1
    transcript.begin(&agv_manager);
    transcript.after(1, format_args!("{}, {}", agv_manager.identity(), agv_manager.mode().as_str()))?;
    agv_manager.start()?; // 2
    transcript.after(2, "started")?;
    let mut s_unit_number = agv_manager.number_of_s_units(); // 3
    transcript.after(3, format_args!("{s_unit_number} s_units"))?;
    while s_unit_number < 1 {
        // 4, 5
        agv_manager.broadcast(); // 6
        transcript.show(6, "searching");
        sleep(Duration::from_secs(2)); // 7
        s_unit_number = agv_manager.number_of_s_units(); // 8
        transcript.show(8, format_args!("{s_unit_number} s_units"));
    } // 9
    transcript.after(9, console::units(&agv_manager))?;
    print!("{}", agv_manager.s_units()[0].their_function_list().show_functions()); // 10
    transcript.after(10, "shown")?;
    let mut pos = Parameters::new(); // 11
    pos.add_int("position", 2)?; // 12
    transcript.after(12, format_args!("pos holds {} variable", pos.len()))?;
    agv_manager.s_units()[0].block_request("pos_info", &mut pos)?; // 13
    transcript.after(13, "answered")?;
    let mut coordinates: [i64; 2]; // 14
    coordinates = pos.variable("position")?; // 15
    transcript.after(15, format_args!("position {coordinates:?}"))?;
    coordinates[0] = 1; // 16
    coordinates[1] = 2; // 17
    pos.set_value("position", coordinates)?; // 18
    transcript.after(18, format_args!("position set to {:?}", pos.variable::<[i64; 2]>("position")?))?;
    agv_manager.s_units()[0].call("go_to", &mut pos).renewing(Renew::Process).send()?; // 19
    transcript.after(19, "accepted")?;
    let mut arguments = Parameters::new(); // 20
    arguments.add_string("fault", 64)?; // 21
    arguments.add_int("minutes", 1)?; // 21
    agv_manager.my_function_list().add_function("call_mechanic", &arguments, call_mechanic)?; // 22
    transcript.after(22, agv_manager.my_function_list().show_functions().trim())?;
    agv_manager.s_units()[0].publish_my_function_list()?; // 23
    transcript.after(23, format_args!("published to {}", agv_manager.s_units()[0].identity()))?;
    agv_manager.publish_my_function_list()?; // 24
    transcript.after(24, "published to all")?;
    // README ends.
    Ok(agv_manager)
}

fn call_mechanic(arguments: Parameters) -> Parameters {
    say!("call_mechanic: {}", arguments.variable::<&str>("fault").unwrap_or("no fault told"));
    mechanic::call_mechanic(arguments)
}
