//! `trabecula doctor`: reports what this machine permits, what each limit costs, and how to lift it.

use std::time::Duration;

use clap::Args;

use crate::failure::Failure;
use crate::machine::{Finding, Grade, Machine, facts};

/// Arguments of `doctor`.
#[derive(Debug, Args)]
pub struct DoctorArguments {
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
    /// How long to measure CPU steal time, in seconds, 0 to 600.
    #[arg(long, default_value_t = 1.0)]
    seconds: f64,
}

/// Inspects the machine and prints the report.
///
/// # Errors
/// A time out of range (2).
pub fn run(arguments: &DoctorArguments) -> Result<(), Failure> {
    if !(0.0..=600.0).contains(&arguments.seconds) {
        return Err(Failure::bad_input(format!("--seconds is {}; allowed: 0 to 600", arguments.seconds)));
    }
    let machine = Machine::watch();
    std::thread::sleep(Duration::from_secs_f64(arguments.seconds));
    let facts = facts(&machine);
    if arguments.json {
        let text = serde_json::to_string_pretty(&facts).map_err(Failure::failed)?;
        say!("{text}");
        return Ok(());
    }
    say!("processor    {}\ncores        {}\nkernel       {}\n", facts.processor, facts.cores, facts.kernel);
    for Finding { name, grade, found, cost, grant } in &facts.findings {
        let mark = match grade {
            Grade::Good => "good   ",
            Grade::Limited => "limited",
            Grade::Missing => "MISSING",
        };
        say!("{mark}  {name}: {found}");
        if *grade != Grade::Good {
            say!("         cost: {cost}\n         fix: {grant}");
        }
    }
    Ok(())
}
