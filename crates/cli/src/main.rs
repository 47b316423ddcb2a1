//! The terrane binary: parses, resolves, calls one library function, prints its report, exits with a documented code.

mod adjust;
mod args;
mod calibrate;
mod compare;
mod config;
mod demo;
mod exit;
mod export;
mod inspect;
mod log;
mod machine;
mod models;
mod progress;
mod remote;
mod run;
mod service;
mod summary;
mod table;

use clap::Parser;

use args::{Arguments, Command};
use exit::Failure;

fn main() -> std::process::ExitCode {
    let arguments = Arguments::parse();
    let json = arguments.json;
    match dispatch(arguments) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(failure) => failure.report(json),
    }
}

fn dispatch(arguments: Arguments) -> Result<(), Failure> {
    let json = arguments.json;
    match arguments.command {
        Command::Run(flags) => service::reactor()?.block_on(run::run(flags, json)),
        Command::Demo(flags) => service::reactor()?.block_on(demo::demo(flags, json)),
        Command::Coordinator(flags) => service::reactor()?.block_on(service::coordinator(flags)),
        Command::Worker(flags) => service::reactor()?.block_on(service::worker(flags)),
        Command::Submit(flags) => service::reactor()?.block_on(remote::submit(flags, json)),
        Command::Status(flags) => service::reactor()?.block_on(remote::status(flags, json)),
        Command::Cancel(flags) => service::reactor()?.block_on(remote::cancel(flags, json)),
        Command::Logs(flags) => service::reactor()?.block_on(remote::logs(flags, json)),
        Command::Export(flags) => export::export(&flags),
        Command::Inspect(flags) => inspect::inspect(&flags, json),
        Command::Compare(flags) => compare::compare(&flags, json),
        Command::Adjust(flags) => adjust::adjust(&flags, json),
        Command::Calibrate(flags) => calibrate::calibrate(&flags, json),
        Command::Hold(flags) => adjust::hold(flags),
        Command::Config(flags) => config::dump(&flags),
    }
}
