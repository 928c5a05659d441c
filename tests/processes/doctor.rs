//! The output of `trabecula doctor`, compared with the hub's behaviour.

use std::path::Path;

use crate::common::client::Client;
use crate::common::program::{Place, parts_of, trabecula, wait_for};
use crate::common::scenes;

/// Returns whether a process has memory with a flag (proc_pid_smaps(5)).
fn has_memory(process: u32, flag: &str) -> bool {
    let maps = std::fs::read_to_string(format!("/proc/{process}/smaps")).unwrap_or_default();
    let flags = maps.lines().filter_map(|line| line.strip_prefix("VmFlags:"));
    flags.flat_map(str::split_whitespace).any(|word| word == flag)
}

/// Regression: it reported that the hub requests no huge pages.
#[test]
fn the_doctor_says_of_huge_pages_what_the_hub_asks_for() {
    if !Path::new("/sys/kernel/mm/transparent_hugepage/enabled").exists() {
        return println!("\n*** SKIPPED: this kernel has no huge pages to ask for ***\n");
    }
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    let session = run.session();
    Client::join(&session).wait_for_state(|state| state.tick >= 100);
    let asked = |flag: &str| -> Vec<String> {
        let mut names: Vec<String> = parts_of(&session)
            .into_iter()
            .chain([("launcher".to_owned(), run.pid())])
            .filter(|(_, pid)| has_memory(*pid, flag))
            .map(|(name, _)| name)
            .collect();
        names.sort();
        names
    };
    // Once its first frame is rendered, the X-ray process has its copies.
    wait_for("huge pages", || (!asked("hg").is_empty()).then_some(()));
    // Transparent huge pages, and huge pages reserved by an administrator.
    assert_eq!((asked("hg"), asked("ht")), (vec!["drr".to_owned()], Vec::new()));
    let said = trabecula(&[&"doctor"]);
    let line = said.out.lines().find(|line| line.contains("huge pages: ")).unwrap();
    assert!(line.contains("to the X-ray's copies of the CT, which request them"), "{line}");
    assert!(line.contains("reserved, which the hub does not use"), "{line}");
}
