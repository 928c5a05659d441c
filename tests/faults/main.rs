//! Seeded faults in the middle of a run: processes that are killed, stopped or starved, clients that
//! misbehave, memory and disks that are full, dead sessions, clocks that step.
//!
//! In every trial the run continues, or stops with an error that names the cause; nothing hangs or panics;
//! the log replays to its end and contains what was published; nothing is left behind; the next run starts.
//! The error, or the next tick, comes within two seconds of polling ([`looks`]).
//!
//! An ordinary test run performs every fault once. For any number of trials, with a table:
//!
//! ```sh
//! TRABECULA_FAULT_TRIALS=500 cargo test --release --test faults -- --nocapture
//! ```
//!
//! `TRABECULA_FAULT_ONLY` selects faults by a part of their name, `TRABECULA_FAULT_SEED` the first seed,
//! `TRABECULA_FAULT_LANES` the number of trials in parallel.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[allow(dead_code, reason = "these tests use a part of what the tests of processes share")]
#[path = "../processes/common/mod.rs"]
mod common;

mod clock;
mod fault;
mod full_memory;
mod guest;
mod looks;
mod scarce;
mod table;
mod trial;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use fault::Fault;
use table::Table;

/// Number of trials in parallel: most of a trial is waiting.
const LANES: u64 = 6;

fn number(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).map_or(otherwise, |text| text.parse().unwrap())
}

#[test]
fn every_fault_is_survived_or_named_and_nothing_published_is_lost() {
    let only = std::env::var("TRABECULA_FAULT_ONLY").unwrap_or_default();
    let faults: Vec<Fault> = Fault::all().into_iter().filter(|fault| fault.name().contains(&only)).collect();
    assert!(!faults.is_empty(), "no fault is named `{only}`");
    let trials = number("TRABECULA_FAULT_TRIALS", faults.len() as u64);
    let first = number("TRABECULA_FAULT_SEED", 1);
    let lanes = number("TRABECULA_FAULT_LANES", LANES);
    let next = AtomicU64::new(0);
    let (table, failures) = (Mutex::new(Table::default()), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..lanes {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    if index >= trials {
                        break;
                    }
                    let (fault, seed) = (faults[index as usize % faults.len()], first + index);
                    match catch_unwind(AssertUnwindSafe(|| trial::make(fault, seed))) {
                        Ok(result) => table.lock().unwrap().add(fault, result),
                        Err(_) => failures.lock().unwrap().push(format!("{} (seed {seed})", fault.name())),
                    }
                }
            });
        }
    });
    println!("{}", table.into_inner().unwrap().text());
    let failures = failures.into_inner().unwrap();
    assert_eq!(failures, Vec::<String>::new(), "{} of {trials} trials failed", failures.len());
}
