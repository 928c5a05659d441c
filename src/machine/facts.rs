//! Describes this machine: its limits, what each one costs, and how to lift it.

use std::path::Path;

use ipc_types::process::set_fifo;
use ipc_types::session::SessionPlan;
use rustix::mm::MlockAllFlags;
use rustix::process::{Resource, getrlimit};
use serde::{Deserialize, Serialize};

use super::confine::{ControlGroup, allowed, control_group};
use super::memory::{MemoryNeed, MemoryPlace, free_shared_bytes, left_of_groups, left_of_machine};
use super::watch::Machine;
use crate::launcher::hub::{Recording, session_plan};
use crate::scenes::BuiltIn;

/// How well a requirement is met.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// Met.
    Good,
    /// Met with limits.
    Limited,
    /// Not met.
    Missing,
}

/// One machine property that timing depends on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Finding {
    /// Name of the requirement.
    pub name: String,
    /// How well it is met.
    pub grade: Grade,
    /// Measured state.
    pub found: String,
    /// Consequence if the requirement is not met.
    pub cost: String,
    /// Command or setting that meets the requirement.
    pub grant: String,
}

/// Description of a machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MachineFacts {
    /// Processor.
    pub processor: String,
    /// Cores that this program may use.
    pub cores: usize,
    /// Kernel.
    pub kernel: String,
    /// What the machine permits.
    pub findings: Vec<Finding>,
}

fn read(path: &str) -> String {
    std::fs::read_to_string(path).unwrap_or_default().trim().to_owned()
}

/// Inspects this machine; `steal` measures the time lost to the hypervisor.
pub fn facts(steal: &Machine) -> MachineFacts {
    let cpuinfo = read("/proc/cpuinfo");
    let model = cpuinfo.lines().find(|line| line.starts_with("model name"));
    let model = model.and_then(|line| line.split_once(": ")).map_or("unknown", |(_, name)| name);
    let virtual_machine = cpuinfo.split_whitespace().any(|word| word == "hypervisor");
    let place = if virtual_machine { ", a virtual machine" } else { "" };
    let cores = allowed().map_or(1, |cores| cores.len());
    MachineFacts {
        processor: format!("{model}{place}"),
        cores,
        kernel: format!("{} {}", read("/proc/sys/kernel/osrelease"), read("/proc/sys/kernel/version")),
        findings: findings(steal, virtual_machine, cores),
    }
}

/// Whether a requirement is met, and the measured state.
type Answer = (Grade, String);

fn findings(steal: &Machine, virtual_machine: bool, cores: usize) -> Vec<Finding> {
    let need = need_of_built_in();
    let all: [(&str, Answer, &str, &str); 12] = [
        (
            "SCHED_FIFO",
            fifo(),
            "`--policy fifo` has no effect: on a busy core, ticks wait up to one scheduler slice (3 to 4 ms)",
            "`ulimit -r 50` after `<user> - rtprio 50` in /etc/security/limits.conf, or `setcap \
             cap_sys_nice+ep trabecula`; in a container `--cap-add SYS_NICE --ulimit rtprio=50`",
        ),
        (
            "nice below 0",
            nice(),
            "the physics gets no higher CPU weight than other programs; DRR and viewer still yield to it",
            "`<user> - nice -15` in /etc/security/limits.conf, or `setcap cap_sys_nice+ep trabecula`",
        ),
        (
            "mlockall",
            memory_lock(need),
            "memory can be paged out; reading a page back from disk takes milliseconds",
            "`<user> - memlock unlimited` in /etc/security/limits.conf, or `ulimit -l unlimited`; in a \
             container `--ulimit memlock=-1`",
        ),
        (
            "affinity",
            affinity(cores),
            "`trabecula stress --cores` cannot limit a run",
            "`taskset -p -c 0-N PID` of the shell, or a wider cpuset of the container (`--cpuset-cpus`)",
        ),
        (
            "control groups",
            quota(),
            "`trabecula stress --quota` cannot limit a run's share of a core; affinity does not need it",
            "`systemd-run --user --scope -p Delegate=yes -p CPUQuota=150% trabecula …`, or run as root",
        ),
        (
            "huge pages",
            huge_pages(),
            "rendering reads the CT in small pages, with more TLB misses; nothing fails",
            "`echo madvise > /sys/kernel/mm/transparent_hugepage/enabled`",
        ),
        (
            "/dev/shm",
            shared_memory(need),
            "a session stores the CT volume and frames there; a run that needs more than is free is refused",
            "`mount -o remount,size=4G /dev/shm`; in a container `--shm-size 4g`",
        ),
        (
            "address space",
            address_space(need),
            "a run whose largest process needs more is refused",
            "`ulimit -v unlimited` and `ulimit -d unlimited`",
        ),
        (
            "memory",
            memory(need),
            "a run that needs more is refused; near the limit, the kernel may kill a part",
            "a higher limit of the control group (in a container `--memory`), more memory, or a coarser CT",
        ),
        (
            "clock source",
            clock_source(),
            "reading a slow clock (hpet, acpi_pm) takes a system call of about a microsecond, about ten \
             times per tick",
            "`echo tsc > /sys/devices/system/clocksource/clocksource0/current_clocksource`",
        ),
        (
            "preemption model",
            preemption(),
            "another program's long system call (a write of megabytes) can delay a tick of any priority by \
             milliseconds",
            "boot with `preempt=full` if the version shows PREEMPT_DYNAMIC, or use a PREEMPT_RT kernel",
        ),
        (
            "steal",
            stolen(steal, virtual_machine),
            "the hypervisor delays ticks by milliseconds at any priority; such misses are counted separately",
            "dedicated cores from the provider (pinned vCPUs), or a physical machine",
        ),
    ];
    let finding = |(name, (grade, found), cost, grant): (&str, Answer, &str, &str)| {
        let [name, cost, grant] = [name, cost, grant].map(str::to_owned);
        Finding { name, grade, found, cost, grant }
    };
    all.into_iter().map(finding).collect()
}

/// The answer for a request that the system denies.
fn refused(cause: impl std::fmt::Display) -> Answer {
    (Grade::Missing, format!("not permitted ({cause})"))
}

/// Tries something in a separate thread, so that any change ends with the thread.
fn tried(what: impl FnOnce() -> std::io::Result<()> + Send + 'static) -> std::io::Result<()> {
    let thread = std::thread::Builder::new().spawn(what)?;
    thread.join().unwrap_or_else(|_| Err(std::io::Error::other("the thread panicked")))
}

fn fifo() -> Answer {
    let throttle =
        (read("/proc/sys/kernel/sched_rt_runtime_us"), read("/proc/sys/kernel/sched_rt_period_us"));
    match tried(|| set_fifo(10)) {
        Ok(()) if throttle.0 == "-1" => (Grade::Good, "permitted, not throttled".to_owned()),
        Ok(()) => (Grade::Good, format!("permitted, throttled to {} of {} µs", throttle.0, throttle.1)),
        Err(cause) => refused(cause),
    }
}

fn nice() -> Answer {
    let outcome = tried(|| Ok(rustix::process::setpriority_process(None, -15)?));
    match outcome {
        Ok(()) => (Grade::Good, "permitted".to_owned()),
        Err(cause) => refused(cause),
    }
}

/// What a run of the built-in scene needs, of which a fit machine has at least as much.
fn need_of_built_in() -> MemoryNeed {
    let plan = BuiltIn::Femur.scene().map(|scene| session_plan(&scene, None, Recording::On));
    let plan = plan.map(|plan| SessionPlan { volume_bytes: BUILT_IN_VOLUME_BYTES, ..plan });
    plan.map_or_else(|_| MemoryNeed::default(), |plan| MemoryNeed::of(&plan))
}

/// Size of the built-in scene's CT: `trabecula phantom femur` prints its dimensions.
const BUILT_IN_VOLUME_BYTES: usize = 2 * 240 * 200 * 320;

/// Compares what a limit leaves with what is needed; `None` if there is no limit.
fn compared(left: Option<u64>, needed: u64, what: &str) -> Answer {
    let mebibytes = |bytes: u64| bytes / (1 << 20);
    let needs = format!("the built-in scene needs {} MiB", mebibytes(needed) + 1);
    match left {
        None => (Grade::Good, format!("{what}no limit; {needs}")),
        Some(left) => {
            let grade = if left < needed { Grade::Missing } else { Grade::Good };
            (grade, format!("{what}{} MiB; {needs}", mebibytes(left)))
        }
    }
}

fn address_space(need: MemoryNeed) -> Answer {
    let limit = |resource| getrlimit(resource).current;
    let (all, data) = (limit(Resource::As), limit(Resource::Data));
    match data.filter(|data| *data < need.data && all.is_none_or(|all| all >= need.address_space)) {
        Some(data) => compared(Some(data), need.data, "data (`ulimit -d`) "),
        None => compared(all, need.address_space, "`ulimit -v` "),
    }
}

fn memory(need: MemoryNeed) -> Answer {
    let least = left_of_groups().into_iter().chain(left_of_machine()).min_by_key(|(_, left)| *left);
    match least {
        Some((MemoryPlace::Group(file), left)) => {
            compared(Some(left), need.total, &format!("the control group ({}) leaves ", file.display()))
        }
        least => compared(least.map(|(_, left)| left), need.total, "available with swap: "),
    }
}

fn memory_lock(need: MemoryNeed) -> Answer {
    // The parts lock their own memory; this only tests it.
    let outcome = rustix::mm::mlockall(MlockAllFlags::CURRENT);
    let _ = rustix::mm::munlockall();
    let limit = getrlimit(Resource::Memlock).current;
    let limit = limit.map_or("no limit".to_owned(), |bytes| format!("limit {} KiB", bytes / 1024));
    let limit = format!("{limit}; the physics of the built-in scene locks {} MiB", need.locked >> 20);
    match outcome {
        Ok(()) => (Grade::Good, format!("permitted, {limit}")),
        Err(cause) => (Grade::Missing, format!("not permitted ({cause}), {limit}")),
    }
}

fn affinity(cores: usize) -> Answer {
    let outcome = tried(|| super::confine::Confinement::enter(1, None).map(|_| ()));
    let online = std::fs::read_to_string("/proc/cpuinfo")
        .map_or(cores, |text| text.lines().filter(|line| line.starts_with("processor")).count());
    match outcome {
        Ok(()) if cores == online => (Grade::Good, format!("permitted, {cores} of {online} cores")),
        Ok(()) => (Grade::Limited, format!("permitted, {cores} of {online} cores")),
        Err(cause) => refused(cause),
    }
}

fn quota() -> Answer {
    match control_group("cpu") {
        Some(ControlGroup { folder, is_first_version, .. }) => {
            let version = if is_first_version { 1 } else { 2 };
            let probe = folder.join(format!("trabecula-doctor-{}", std::process::id()));
            let made = std::fs::create_dir(&probe);
            let _ = std::fs::remove_dir(&probe);
            match made {
                Ok(()) => (Grade::Good, format!("version {version}, {} can be subdivided", folder.display())),
                Err(cause) => (Grade::Missing, format!("version {version}, {}: {cause}", folder.display())),
            }
        }
        None => (Grade::Missing, "no hierarchy with the `cpu` controller".to_owned()),
    }
}

fn huge_pages() -> Answer {
    let (transparent, memory) = (read("/sys/kernel/mm/transparent_hugepage/enabled"), read("/proc/meminfo"));
    let total = memory.lines().find_map(|line| line.strip_prefix("HugePages_Total:")).map_or("0", str::trim);
    let chosen = transparent.split(['[', ']']).nth(1).unwrap_or("unavailable").to_owned();
    let (grade, granted) = match chosen.as_str() {
        // The hub requests huge pages explicitly (madvise), so either setting works.
        "always" | "madvise" => (Grade::Good, "granted to the X-ray's copies of the CT, which request them"),
        _ => (Grade::Limited, "refused to the X-ray's copies of the CT, which request them"),
    };
    (grade, format!("transparent: {chosen}: {granted}; {total} reserved, which the hub does not use"))
}

fn shared_memory(need: MemoryNeed) -> Answer {
    let Ok(info) = rustix::fs::statvfs("/dev/shm") else {
        return (Grade::Missing, "does not exist".to_owned());
    };
    let size = info.f_blocks * info.f_frsize / (1 << 20);
    let (grade, found) = compared(free_shared_bytes(), need.shared, &format!("{size} MiB, free "));
    // Room for a larger CT than the built-in one.
    let is_small = free_shared_bytes().is_some_and(|free| free < 512 << 20);
    (if grade == Grade::Good && is_small { Grade::Limited } else { grade }, found)
}

fn clock_source() -> Answer {
    let folder = "/sys/devices/system/clocksource/clocksource0";
    let current = read(&format!("{folder}/current_clocksource"));
    let available = read(&format!("{folder}/available_clocksource"));
    let grade = match current.as_str() {
        "tsc" | "kvm-clock" | "arch_sys_counter" => Grade::Good,
        _ => Grade::Limited,
    };
    (grade, format!("{current} (available: {available})"))
}

fn preemption() -> Answer {
    let version = read("/proc/sys/kernel/version");
    let command_line = read("/proc/cmdline");
    let given = command_line.split(' ').find(|word| word.starts_with("preempt="));
    let config = kernel_config();
    let is_set = |name: &str| config.lines().any(|line| line == format!("CONFIG_{name}=y"));
    let built = [
        ("PREEMPT_NONE", "none"),
        ("PREEMPT_VOLUNTARY", "voluntary"),
        ("PREEMPT_LAZY", "lazy"),
        ("PREEMPT", "full"),
    ];
    let built = built.into_iter().find(|(name, _)| is_set(name)).map(|(_, model)| model);
    let model = match (version.contains("PREEMPT_RT"), given, built) {
        (true, _, _) => "real time".to_owned(),
        (_, Some(word), _) => word.trim_start_matches("preempt=").to_owned(),
        (_, None, Some(model)) => model.to_owned(),
        (_, None, None) => "unknown".to_owned(),
    };
    let grade = match model.as_str() {
        "real time" | "full" => Grade::Good,
        _ => Grade::Limited,
    };
    (grade, format!("{model} ({version})"))
}

/// Returns the kernel's configuration.
fn kernel_config() -> String {
    let release = read("/proc/sys/kernel/osrelease");
    let boot = std::fs::read_to_string(format!("/boot/config-{release}"));
    boot.or_else(|_| unpacked(Path::new("/proc/config.gz"))).unwrap_or_default()
}

fn unpacked(path: &Path) -> std::io::Result<String> {
    let mut text = String::new();
    std::io::Read::read_to_string(&mut flate2::read::GzDecoder::new(std::fs::File::open(path)?), &mut text)?;
    Ok(text)
}

fn stolen(watched: &Machine, virtual_machine: bool) -> Answer {
    let (busy, stolen) = watched.shares_percent();
    let grade = match stolen {
        _ if !virtual_machine => Grade::Good,
        stolen if stolen < 0.5 => Grade::Good,
        _ => Grade::Limited,
    };
    (
        grade,
        format!("{stolen:.2} % of the machine while {busy:.0} % was busy, over {:.1} s", watched.seconds()),
    )
}
