//! Confines a run to some cores by affinity, and to a share of them by a CPU quota where a cgroup can be
//! created.
//!
//! Affinity and cgroup apply to this thread; everything that it starts meanwhile inherits both. Dropping the
//! guard restores them.

use std::path::{Path, PathBuf};

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Period of the quota: the kernel's default.
const PERIOD_US: u64 = 100_000;

/// Guard that confines this thread until dropped.
#[derive(Debug)]
pub struct Confinement {
    before: CpuSet,
    group: Option<Group>,
    /// A request that was not permitted.
    pub remark: Option<String>,
}

/// A cgroup created for this run.
#[derive(Debug)]
struct Group {
    folder: PathBuf,
    /// Files that accept threads (version 1) or processes (version 2), of the group and of the original
    /// group.
    members: PathBuf,
    home: PathBuf,
}

/// Returns the indices of the cores that this thread may use.
pub fn allowed() -> std::io::Result<Vec<usize>> {
    let set = sched_getaffinity(None)?;
    Ok((0..CpuSet::MAX_CPU).filter(|core| set.is_set(*core)).collect())
}

impl Confinement {
    /// Confines this thread to the first `cores` of its cores, and to `quota_percent` of one core if given.
    ///
    /// # Errors
    /// The affinity cannot be set. A quota that is not permitted only leaves a remark.
    pub fn enter(cores: usize, quota_percent: Option<u64>) -> std::io::Result<Confinement> {
        let before = sched_getaffinity(None)?;
        let mut set = CpuSet::new();
        allowed()?.into_iter().take(cores.max(1)).for_each(|core| set.set(core));
        sched_setaffinity(None, &set)?;
        let mut confined = Confinement { before, group: None, remark: None };
        if let Some(percent) = quota_percent {
            match Group::enter(percent) {
                Ok(group) => confined.group = Some(group),
                Err(cause) => confined.remark = Some(format!("no CPU quota: {cause}")),
            }
        }
        Ok(confined)
    }
}

impl Drop for Confinement {
    fn drop(&mut self) {
        // Restores the earlier affinity, which was permitted.
        let _ = sched_setaffinity(None, &self.before);
    }
}

impl Group {
    fn enter(percent: u64) -> Result<Group, String> {
        let ControlGroup { folder: parent, is_first_version: first_version, .. } =
            control_group("cpu").ok_or("no control group with the `cpu` controller is mounted")?;
        let folder = parent.join(format!("trabecula-stress-{}", std::process::id()));
        let told = |path: &Path, cause: std::io::Error| format!("{}: {cause}", path.display());
        std::fs::create_dir(&folder).map_err(|cause| told(&folder, cause))?;
        let file = if first_version { "tasks" } else { "cgroup.procs" };
        let group = Group { members: folder.join(file), home: parent.join(file), folder };
        let quota_us = percent * PERIOD_US / 100;
        let write = |name: &str, text: String| {
            let path = group.folder.join(name);
            std::fs::write(&path, text).map_err(|cause| told(&path, cause))
        };
        if first_version {
            write("cpu.cfs_period_us", PERIOD_US.to_string())?;
            write("cpu.cfs_quota_us", quota_us.to_string())?;
            // Without this the group may not hold SCHED_FIFO threads; kernels without group scheduling have
            // no such file.
            let _ = write("cpu.rt_runtime_us", "900000".to_owned());
        } else {
            write("cpu.max", format!("{quota_us} {PERIOD_US}"))?;
        }
        std::fs::write(&group.members, "0").map_err(|cause| told(&group.members, cause))?;
        Ok(group)
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        // These fail only if another process has removed the groups.
        let _ = std::fs::write(&self.home, "0");
        let _ = std::fs::remove_dir(&self.folder);
    }
}

/// The cgroup of this process for one controller.
#[derive(Debug)]
pub struct ControlGroup {
    /// Its folder.
    pub folder: PathBuf,
    /// Where the hierarchy is mounted.
    pub mount: PathBuf,
    /// Version 1, where each controller has its own hierarchy.
    pub is_first_version: bool,
}

/// Returns this process's cgroup with a controller, such as `cpu`, or `None` without one.
pub fn control_group(controller: &str) -> Option<ControlGroup> {
    let mounts = std::fs::read_to_string("/proc/self/mounts").ok()?;
    let own = std::fs::read_to_string("/proc/self/cgroup").ok()?;
    let has = |list: &str| list.split([',', ' ', '\n']).any(|name| name == controller);
    for line in mounts.lines() {
        let mut words = line.split(' ');
        let (_, point, kind, options) = (words.next()?, words.next()?, words.next()?, words.next()?);
        let point = Path::new(point);
        let first_version = kind == "cgroup" && has(options);
        let controllers = || std::fs::read_to_string(point.join("cgroup.controllers")).unwrap_or_default();
        let second_version = kind == "cgroup2" && has(&controllers());
        if !first_version && !second_version {
            continue;
        }
        // hierarchy:controllers:path; in version 2 the list is empty (cgroups(7)).
        let path = own.lines().find_map(|line| {
            let mut fields = line.splitn(3, ':');
            let (_, list, path) = (fields.next()?, fields.next()?, fields.next()?);
            (if first_version { has(list) } else { list.is_empty() }).then_some(path)
        })?;
        let folder = point.join(path.trim_start_matches('/'));
        return Some(ControlGroup {
            folder: if folder.is_dir() { folder } else { point.to_owned() },
            mount: point.to_owned(),
            is_first_version: first_version,
        });
    }
    None
}
