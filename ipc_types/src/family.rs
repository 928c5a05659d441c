//! Parents and children: ties a process's lifetime to its parent's, and finds all descendants of a process.

use std::os::unix::process::CommandExt;
use std::process::Command;

use rustix::io::Errno;
use rustix::process::{Pid, Signal, getpid, getppid, set_parent_process_death_signal, setsid};

/// Has the kernel send SIGTERM to this process when its parent dies, so that a killed launcher leaves no
/// orphans. This misses a parent that died earlier, so a part checks its session's lock afterwards
/// ([`host_is_alive`](crate::session::host_is_alive)).
pub fn end_with_parent() {
    // If the kernel refuses, the process still ends when its session's states stop.
    let _ = set_parent_process_death_signal(Some(Signal::TERM));
}

/// As [`end_with_parent`], for a program about to be started; also puts it into its own session. The
/// terminal's Ctrl-C then does not reach it, because the launcher ends its parts in order, and the kernel
/// shares cores between it and everything else ([`prioritise`](crate::process::prioritise)). The thread that
/// starts it counts as its parent.
pub fn bind_to_parent(command: &mut Command) -> &mut Command {
    bind_to_parent_with(command, Signal::TERM)
}

/// As [`bind_to_parent`], with another signal.
pub fn bind_to_parent_with(command: &mut Command, signal: Signal) -> &mut Command {
    let parent = getpid();
    // SAFETY: the closure runs between fork and exec, where only async-signal-safe calls are allowed; it
    // makes three system calls (prctl, getppid, setsid), allocates nothing and takes no lock.
    unsafe {
        command.pre_exec(move || {
            let _ = set_parent_process_death_signal(Some(signal));
            // A parent that died between the fork and this line sends no signal.
            if getppid() != Some(parent) {
                return Err(Errno::SRCH.into());
            }
            setsid()?;
            Ok(())
        })
    }
}

/// Lists all living descendants of a process, whatever group or session they have created. Orphans count as
/// children of their nearest subreaper (`PR_SET_CHILD_SUBREAPER`).
pub fn descendants(of: Pid) -> Vec<Pid> {
    let pairs = families();
    let mut found = vec![of];
    let mut looked_at = 0;
    while let Some(parent) = found.get(looked_at).copied() {
        looked_at += 1;
        found.extend(pairs.iter().filter(|(_, its)| *its == parent).map(|(child, _)| *child));
    }
    found.remove(0);
    found
}

/// Lists this process's living children.
pub fn children() -> Vec<Pid> {
    let own = getpid();
    families().into_iter().filter(|(_, parent)| *parent == own).map(|(child, _)| child).collect()
}

/// Lists every living process with its parent.
fn families() -> Vec<(Pid, Pid)> {
    let entries = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| parentage(entry.file_name().to_str()?)).collect()
}

/// Returns a living process with its parent; `None` if it is dead or its parent is outside this PID
/// namespace.
fn parentage(process: &str) -> Option<(Pid, Pid)> {
    let parent = living_parent(process)?;
    Some((Pid::from_raw(process.parse().ok()?)?, Pid::from_raw(parent)?))
}

/// Returns whether a process with this number is alive in this PID namespace. A zombie is not.
pub fn is_alive(process: u32) -> bool {
    living_parent(&process.to_string()).is_some()
}

/// Process number of a living process's parent; 0 if the parent is outside this PID namespace.
fn living_parent(process: &str) -> Option<i32> {
    let text = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // State and parent follow the name, which may contain anything (proc_pid_stat(5)).
    let mut fields = text.rsplit_once(')')?.1.split_whitespace();
    let is_dead = matches!(fields.next()?, "Z" | "X");
    let parent = fields.next()?.parse().ok()?;
    (!is_dead).then_some(parent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn children_and_their_children_are_found() {
        let mut child = Command::new("sh").args(["-c", "sleep 60 & sleep 60"]).spawn().unwrap();
        let of_child = Pid::from_raw(child.id() as i32).unwrap();
        let end = std::time::Instant::now() + std::time::Duration::from_secs(20);
        while descendants(of_child).len() < 2 {
            assert!(std::time::Instant::now() < end, "{:?}", descendants(of_child));
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        let own = descendants(getpid());
        let all = descendants(of_child);
        assert!(own.contains(&of_child) && all.iter().all(|pid| own.contains(pid)));
        all.iter().for_each(|pid| rustix::process::kill_process(*pid, Signal::KILL).unwrap());
        child.kill().unwrap();
        child.wait().unwrap();
    }
}
