//! Misses of a physics that was stopped, frozen or throttled are attributed to that cause, not to stolen
//! time.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use rustix::process::Signal;
use serde_json::Value;

use crate::common::client::Client;
use crate::common::program::{Guarded, Place, Run, signal};
use crate::common::scenes;

const HELD: Duration = Duration::from_millis(600);

/// Disturbs a running run, and returns the misses of its summary.
fn misses(run: Run, disturb: impl FnOnce(&Run, &Client)) -> Value {
    let client = Client::at(&run, 300);
    disturb(&run, &client);
    let now = client.wait_for_state(|_| true).tick;
    client.wait_for_state(|state| state.tick >= now + 200);
    let ended = client.stop(run);
    assert!(ended.out.contains("% confirmed)"), "the table says how much is confirmed: {}", ended.out);
    ended.summary()["timing"]["misses"].clone()
}

fn lost_ms(misses: &Value, cause: &str) -> f64 {
    misses["lost_ms"][cause].as_f64().unwrap_or(0.0)
}

/// However busy the machine is, the gap itself is attributed correctly, and stolen time does not exceed the
/// counter.
fn assert_named(misses: &Value, cause: &str) {
    assert!(lost_ms(misses, cause) >= 0.8 * HELD.as_secs_f64() * 1e3, "{misses:#}");
    assert!(lost_ms(misses, "stolen") <= misses["steal_counter_ms"].as_f64().unwrap() + 1e-6, "{misses:#}");
}

/// Regression: 600 ms of SIGSTOP became 652 ms "stolen" with a counter of 0.
#[test]
fn a_stopped_physics_is_called_stopped_and_not_stolen() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 600.0));
    let misses = misses(run, |run, _| {
        let physics = run.part("physics");
        signal(physics, Signal::STOP);
        std::thread::sleep(HELD);
        signal(physics, Signal::CONT);
    });
    assert_named(&misses, "stopped");
}

/// A control group created by a test, empty when dropped.
pub(crate) struct Group(pub(crate) PathBuf);

impl Group {
    /// Creates a group below a mounted hierarchy whose groups have a file of this name.
    fn make(needed: &str) -> Result<Group, String> {
        let mounts = fs::read_to_string("/proc/self/mounts").unwrap();
        let mut causes = Vec::new();
        for line in
            mounts.lines().filter(|line| line.split(' ').nth(2).is_some_and(|k| k.starts_with("cgroup")))
        {
            let folder = Path::new(line.split(' ').nth(1).unwrap()).join(format!(
                "trabecula-test-{}-{}",
                std::process::id(),
                fastrand::u64(..)
            ));
            if let Err(cause) = fs::create_dir(&folder) {
                causes.push(format!("{}: {cause}", folder.display()));
                continue;
            }
            let group = Group(folder);
            if group.0.join(needed).exists() {
                return Ok(group);
            }
        }
        Err(format!("no group with `{needed}`: {}", causes.join(", ")))
    }

    pub(crate) fn write(&self, name: &str, text: &str) {
        fs::write(self.0.join(name), text).unwrap();
    }

    /// Returns a command that runs in the group.
    pub(crate) fn command(&self, program: &str) -> Command {
        let mut command = Command::new("sh");
        let enter = format!("echo $$ > {}/cgroup.procs && exec \"$@\"", self.0.display());
        command.args(["-c", &enter, "sh", program]);
        command
    }

    fn start(&self, place: &Place) -> Run {
        let scene = place.scene(&scenes::hold("realtime", 600.0));
        let mut command = self.command(env!("CARGO_BIN_EXE_trabecula"));
        command.arg("run").arg(scene).arg("--output").arg(place.path("out")).arg("--quiet");
        Run::of(command, place.path("out"))
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        // A failed test may have left it frozen; then its processes could not even be killed.
        let _ = fs::write(self.0.join("cgroup.freeze"), "0");
        for _ in 0..200 {
            if fs::remove_dir(&self.0).is_ok() {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

pub(crate) fn group(needed: &str) -> Option<Group> {
    Group::make(needed).inspect_err(|cause| eprintln!("SKIPPED: {cause}")).ok()
}

#[test]
fn a_frozen_physics_is_called_stopped_and_not_stolen() {
    // Kernels before 6.18 do not report how long a group was frozen.
    let Some(group) = group("cgroup.stat.local") else { return };
    if !fs::read_to_string(group.0.join("cgroup.stat.local")).unwrap().contains("frozen_usec") {
        eprintln!("SKIPPED: this kernel does not say how long a control group was frozen");
        return;
    }
    let place = Place::new();
    let misses = misses(group.start(&place), |_, _| {
        group.write("cgroup.freeze", "1");
        std::thread::sleep(HELD);
        group.write("cgroup.freeze", "0");
    });
    assert_named(&misses, "stopped");
}

#[test]
fn a_physics_whose_group_has_used_up_its_quota_is_called_throttled_and_not_stolen() {
    let (group, limit) = match (Group::make("cpu.cfs_quota_us"), Group::make("cpu.max")) {
        (Ok(group), _) => (group, [("cpu.cfs_period_us", "100000"), ("cpu.cfs_quota_us", "5000")].to_vec()),
        (_, Ok(group)) => (group, [("cpu.max", "5000 100000")].to_vec()),
        (Err(first), Err(second)) => {
            eprintln!("SKIPPED: {first}; {second}");
            return;
        }
    };
    let place = Place::new();
    // A quota that even a busy machine leaves to the group, used up immediately however little the run itself
    // needs.
    let busy = Guarded(group.command("sh").args(["-c", "while :; do :; done"]).spawn().unwrap());
    let run = group.start(&place);
    let misses = misses(run, |_, client| {
        limit.iter().for_each(|(name, text)| group.write(name, text));
        let now = client.wait_for_state(|_| true).tick;
        // At 1 kHz and 5 % of a core there are dozens of periods, most of each of which is lost.
        client.wait_for_state(|state| state.tick >= now + 400);
        let free = if limit.len() > 1 { ("cpu.cfs_quota_us", "-1") } else { ("cpu.max", "max") };
        group.write(free.0, free.1);
    });
    drop(busy);
    assert_named(&misses, "throttled");
}
