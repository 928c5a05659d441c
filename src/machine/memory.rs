//! The memory that a run needs, compared before it starts with what the machine and its limits leave.

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};

use ipc_types::messages::services::{FRAME, Service};
use ipc_types::session::SessionPlan;
use rustix::process::{Resource, getrlimit};

use super::confine::control_group;

const MIB: u64 = 1 << 20;
/// What an empty `tmpfs` uses itself, rounded up.
const FILE_SYSTEM_BYTES: u64 = 64 << 10;

/// Private address space of the recorder, whose indexes have up to 64 MiB.
const RECORDER_BYTES: u64 = 95 * MIB;
/// Private address space of the physics without bone.
const PHYSICS_BYTES: u64 = 50 * MIB;
/// Private address space of DRR without its copy of the CT.
const DRR_BYTES: u64 = 45 * MIB;
/// Private address space of the launcher, most of it for the figures of the report.
const LAUNCHER_BYTES: u64 = 145 * MIB;
/// Private data of all processes together, without the CT.
const PRIVATE_BYTES: u64 = 200 * MIB;
/// Images that the recorder holds until the tick is written at which the log has them.
const HELD_FRAMES: u64 = 32;
/// The bytes of them that it holds at most.
const HELD_BYTES: u64 = 256 * MIB;

/// Memory that a run needs, bytes. The shared part follows from the ports of its session. The private parts
/// are measured (VmPeak and RssAnon with one allocation arena, for CTs of 0 to 234 MiB), rounded up.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct MemoryNeed {
    /// In `/dev/shm`.
    pub shared: u64,
    /// Address space of the largest process.
    pub address_space: u64,
    /// Private data of the largest process.
    pub data: u64,
    /// Memory of all processes together.
    pub total: u64,
    /// Memory of the physics, all of which it locks in real time.
    pub locked: u64,
}

impl MemoryNeed {
    /// Returns what a run with this session needs.
    pub fn of(plan: &SessionPlan) -> MemoryNeed {
        let (ct, frame, shared) = (plan.volume_bytes as u64, plan.frame_bytes as u64, plan.shared_bytes());
        let frames = Service { max_bytes: plan.frame_bytes, ..FRAME }.reserved_bytes();
        let has_drr = u64::from(frame > 0);
        // DRR copies the CT into its own order.
        let drr = has_drr * (DRR_BYTES + ct + ct / 10 + 8 * frame);
        let physics = PHYSICS_BYTES + ct / 5;
        let recorder = u64::from(plan.recorder) * (RECORDER_BYTES + HELD_BYTES.min(HELD_FRAMES * frame));
        // It holds the CT until it has published it.
        let launcher = LAUNCHER_BYTES + ct;
        let largest = drr.max(physics).max(recorder);
        MemoryNeed {
            shared,
            address_space: (shared + largest).max(launcher + ct + has_drr * frames),
            data: largest.max(launcher),
            total: shared + PRIVATE_BYTES + ct + ct / 3,
            locked: shared + physics,
        }
    }

    /// Returns the first limit that leaves less than the run needs.
    pub fn shortage(&self) -> Option<MemoryShortage> {
        let address_space = getrlimit(Resource::As).current;
        let data = getrlimit(Resource::Data).current;
        let limits = [
            (MemoryPlace::SharedMemory, self.shared, free_shared_bytes()),
            (MemoryPlace::AddressSpace, self.address_space, address_space),
            (MemoryPlace::Data, self.data, data),
        ];
        let of_machine = || {
            let (place, left) =
                left_of_groups().into_iter().chain(left_of_machine()).min_by_key(|it| it.1)?;
            Some((place, self.total, Some(left)))
        };
        let short = |(place, needed, left): (MemoryPlace, u64, Option<u64>)| {
            let left = left.filter(|left| *left < needed)?;
            Some(MemoryShortage { place, needed, left })
        };
        limits.into_iter().chain(of_machine()).find_map(short)
    }
}

/// Where memory is limited.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MemoryPlace {
    /// `/dev/shm`.
    SharedMemory,
    /// RLIMIT_AS.
    AddressSpace,
    /// RLIMIT_DATA.
    Data,
    /// A control group's limit, in this file.
    Group(PathBuf),
    /// The machine.
    Machine,
}

/// A limit that leaves less memory than a run needs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct MemoryShortage {
    /// The limit.
    pub place: MemoryPlace,
    /// Bytes that the run needs.
    pub needed: u64,
    /// Bytes that the limit leaves.
    pub left: u64,
}

impl Display for MemoryShortage {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        // A file system of the size that is named has less than that free.
        let own = if self.place == MemoryPlace::SharedMemory { FILE_SYSTEM_BYTES } else { 0 };
        let [needed, left] = [(self.needed + own).div_ceil(MIB), self.left / MIB];
        let kib = self.needed.div_ceil(1024);
        match &self.place {
            MemoryPlace::SharedMemory => write!(
                f,
                "/dev/shm: the run needs {needed} MiB of shared memory, {left} MiB are free; free some space \
                 or enlarge /dev/shm (`mount -o remount,size=SIZE /dev/shm`; in a container `--shm-size SIZE`)"
            ),
            MemoryPlace::AddressSpace => write!(
                f,
                "address space: the largest process of the run needs about {needed} MiB, the limit is {left} \
                 MiB; raise it with `ulimit -v {kib}` or `ulimit -v unlimited`"
            ),
            MemoryPlace::Data => write!(
                f,
                "data segment: the largest process of the run needs about {needed} MiB, the limit is {left} \
                 MiB; raise it with `ulimit -d {kib}` or `ulimit -d unlimited`"
            ),
            MemoryPlace::Group(file) => write!(
                f,
                "{}: the run needs about {needed} MiB of memory, the control group leaves {left} MiB; raise \
                 its limit (in a container `--memory`)",
                file.display()
            ),
            MemoryPlace::Machine => write!(
                f,
                "memory: the run needs about {needed} MiB, the machine has {left} MiB available, with swap; \
                 end other programs, or use a coarser or smaller CT"
            ),
        }
    }
}

/// Returns the free bytes of shared memory; `None` if its file system does not report them.
pub fn free_shared_bytes() -> Option<u64> {
    let stat = rustix::fs::statvfs("/dev/shm").ok().filter(|stat| stat.f_blocks > 0)?;
    Some(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Returns the limit of each control group above this process that has one, and what it leaves.
pub fn left_of_groups() -> Vec<(MemoryPlace, u64)> {
    let Some(group) = control_group("memory") else { return Vec::new() };
    let (limit, used) = match group.is_first_version {
        true => ("memory.limit_in_bytes", "memory.usage_in_bytes"),
        false => ("memory.max", "memory.current"),
    };
    let folders = group.folder.ancestors().take_while(|folder| folder.starts_with(&group.mount));
    let left = |folder: &Path| {
        let number = |name: &str| std::fs::read_to_string(folder.join(name)).ok()?.trim().parse::<u64>().ok();
        // A version 2 group without a limit has the text `max`, one of version 1 nearly 2^63.
        let most = number(limit).filter(|most| *most < 1 << 62)?;
        let used = number(used)?.saturating_sub(cached_bytes(&folder.join("memory.stat")));
        Some((MemoryPlace::Group(folder.join(limit)), most.saturating_sub(used)))
    };
    folders.filter_map(left).collect()
}

/// Returns the bytes of files that a group caches, which the kernel drops when the group needs memory.
fn cached_bytes(stat: &Path) -> u64 {
    let text = std::fs::read_to_string(stat).unwrap_or_default();
    // Version 1 has sums over the groups below under other names.
    let sum = |prefix: &str| -> u64 {
        let names = ["inactive_file", "active_file"].map(|name| format!("{prefix}{name} "));
        let numbers = text.lines().filter_map(|line| {
            let number = names.iter().find_map(|name| line.strip_prefix(name.as_str()))?;
            number.parse::<u64>().ok()
        });
        numbers.sum()
    };
    sum("total_").max(sum(""))
}

/// Returns the memory that the kernel can give to new programs, with swap.
pub fn left_of_machine() -> Option<(MemoryPlace, u64)> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let bytes = |name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name))?;
        line.trim().strip_suffix(" kB")?.parse::<u64>().ok().map(|kib| kib * 1024)
    };
    Some((MemoryPlace::Machine, bytes("MemAvailable:")? + bytes("SwapFree:").unwrap_or(0)))
}

/// Returns how many processes the kernel has killed because memory ran out, since the machine started.
pub fn out_of_memory_kills() -> u64 {
    let text = std::fs::read_to_string("/proc/vmstat").unwrap_or_default();
    let number = text.lines().find_map(|line| line.strip_prefix("oom_kill "));
    number.and_then(|number| number.parse().ok()).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::scene::{Policy, Wait};

    fn plan(volume_bytes: usize, frame_bytes: usize) -> SessionPlan {
        SessionPlan {
            controllers: vec!["a".to_owned()],
            volume_bytes,
            frame_bytes,
            sensors: false,
            tip_jacobian: false,
            recorder: true,
            wait: Wait::Event,
            policy: Policy::Other,
        }
    }

    /// Measured: VmPeak of the largest process with one arena, shared memory by `du`, MiB.
    #[test]
    fn the_need_of_a_run_is_what_was_measured_and_at_most_a_third_more() {
        let femur = 29 << 20;
        let frame = 512 * 512 * 2;
        for (plan, largest_mib, shared_mib) in
            [(plan(0, 0), 220, 128), (plan(femur, frame), 251, 187), (plan(234 << 20, frame), 672, 392)]
        {
            let need = MemoryNeed::of(&plan);
            for (needed, measured_mib) in [(need.address_space, largest_mib), (need.shared, shared_mib)] {
                let needed_mib = needed / MIB;
                assert!(
                    (measured_mib..=measured_mib * 4 / 3).contains(&needed_mib),
                    "{needed_mib} MiB, measured {measured_mib}: {need:?}"
                );
            }
        }
    }

    #[test]
    fn files_that_a_group_caches_do_not_count_as_used() {
        let folder = tempfile::tempdir().unwrap();
        let stat = folder.path().join("memory.stat");
        let cached = |text: &str| {
            std::fs::write(&stat, text).unwrap();
            cached_bytes(&stat)
        };
        assert_eq!(cached("anon 7\ninactive_file 100\nactive_file 20\nfile 130\n"), 120);
        let first =
            "cache 1\ninactive_file 1\nactive_file 2\ntotal_inactive_file 300\ntotal_active_file 50\n";
        assert_eq!(cached(first), 350);
        assert_eq!(cached(""), 0);
    }
}
