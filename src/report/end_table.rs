//! The table printed at the end of a run.

use std::fmt;

use super::distribution::Quantiles;
use super::summary::{LogSummary, MissSummary, NOT_SHARED, Summary};

impl LogSummary {
    /// Returns `ticks 2233 to 5812 (3580) are missing from the log`, or `None` if no tick is missing.
    fn describe_missing(&self) -> Option<String> {
        let gaps = &self.missing_ticks;
        let count: u64 = gaps.iter().map(|[first, last]| last - first + 1).sum();
        let shown = gaps.iter().take(GAPS_SHOWN).map(|[first, last]| format!("{first} to {last}"));
        let shown = shown.collect::<Vec<_>>().join(", ");
        let more = gaps.len().saturating_sub(GAPS_SHOWN);
        let more = if more > 0 { format!(" and {more} more gaps") } else { String::new() };
        (count > 0).then(|| format!("ticks {shown}{more} ({count}) are missing from the log"))
    }
}

/// Maximum number of gaps listed individually.
const GAPS_SHOWN: usize = 3;

/// The table at the end of a run: 22 lines, plus one per caution, structure and controller after the third.
impl fmt::Display for Summary {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let unknown = || "unknown".to_string();
        let row = |name: &str, text: String| format!("{name:<13}{text}\n");
        let mut table = row(
            "run",
            format!(
                "{} ({}), {}",
                self.scene.clone().unwrap_or_else(unknown),
                self.mode.clone().unwrap_or_else(unknown),
                self.outcome
            ),
        );
        let factor = self.real_time_factor.map_or(String::new(), |f| format!(", {f:.2} x real time"));
        let (simulated_s, wall_s, startup_s) = (self.simulated_s, self.wall_s, self.startup_s);
        table += &row(
            "time",
            format!("{simulated_s:.3} s simulated in {wall_s:.3} s{factor}, start {startup_s:.2} s"),
        );
        let hash = self.final_hash.clone().unwrap_or_else(|| "none".to_string());
        table += &row("ticks", format!("{}, hash {hash}", self.ticks));
        for (name, text) in self.tool_rows().into_iter().chain(self.timing_rows()).chain(self.log_rows()) {
            table += &row(name, text);
        }
        out.write_str(table.trim_end())
    }
}

type Rows = Vec<(&'static str, String)>;

impl Summary {
    fn tool_rows(&self) -> Rows {
        let mut rows = Rows::new();
        if let Some(tool) = &self.tool {
            let point = |p: [f64; 3]| format!("{:.2} {:.2} {:.2}", p[0], p[1], p[2]);
            let (start, end) = (point(tool.tip_start_mm), point(tool.tip_deepest_mm));
            let error = tool.target_error_mm.map_or(String::new(), |mm| format!(", {mm:.2} mm off target"));
            rows.push(("tip", format!("{start} -> {end} mm{error}")));
            rows.push((
                "bend",
                format!("{:.2} deg, maximum tension {:.2} N", tool.bend_deg, tool.max_tension_n),
            ));
        }
        if let Some(drilling) = &self.drilling {
            let volume = drilling.removed_volume_mm3.map_or(String::new(), |mm3| format!(" ({mm3:.1} mm3)"));
            let (voxels, energy) = (drilling.removed_voxels, drilling.cutting_energy_j);
            let crushed = drilling.crushing_energy_j;
            let crushed = if crushed > 0.0 { format!(", {crushed:.3} J crushing") } else { String::new() };
            rows.push(("drilled", {
                let voxels = foreign_text::counted(voxels, "voxel");
                let area = drilling.breach_area_text().map_or(String::new(), |text| format!(", {text}"));
                format!("{voxels}{volume}, {energy:.2} J cutting{crushed}{area}")
            }));
            let text = format!(
                "up to {} at once, in {:.1} % of ticks; maximum burr {:.2} N, walls {:.2} N, flange {:.2} N",
                drilling.max_contacts,
                100.0 * drilling.contact_share,
                drilling.max_burr_force_n,
                drilling.max_wall_force_n,
                drilling.max_flange_force_n
            );
            rows.push(("contacts", text));
        }
        rows.extend(self.plan_rows());
        if let Some(drr) = &self.drr {
            let render = drr
                .render_ms
                .map_or(String::new(), |q| format!(", render p50 {:.1} p99 {:.1} ms", q.p50, q.p99));
            let rate = drr.frames_per_wall_s.map_or(String::new(), |hz| format!(", {hz:.1} per wall s"));
            rows.push(("DRR frames", format!("{} ({} full){render}{rate}", drr.frames, drr.full_frames)));
        }
        rows.extend(self.cautions.iter().map(|caution| ("caution", caution.clone())));
        rows
    }

    fn plan_rows(&self) -> Rows {
        let Some(plan) = &self.plan else { return Rows::new() };
        let mut rows = Rows::new();
        if let Some((most_mm, at_mm)) = plan.path_deviation_mm.zip(plan.path_deviation_at_mm) {
            let radius =
                plan.least_radius_mm.map_or(String::new(), |mm| format!(", bent to a radius of {mm:.1} mm"));
            let possible =
                plan.possible_radius_mm.map_or(String::new(), |mm| format!(" (possible: {mm:.1})"));
            rows.push((
                "path",
                format!("{most_mm:.2} mm off the plan, {at_mm:.1} mm along it{radius}{possible}"),
            ));
        }
        let forces =
            [("burr", &plan.forces.burr), ("walls", &plan.forces.walls), ("flange", &plan.forces.flange)];
        let largest = forces.into_iter().max_by(|a, b| a.1.force_n.total_cmp(&b.1.force_n));
        if let Some((what, peak)) = largest.filter(|(_, peak)| peak.force_n > 0.0) {
            rows.push(("largest", format!("{what} {}", peak.text())));
        }
        for structure in &self.structures {
            if let Some(least_mm) = structure.least_clearance_mm {
                rows.push((
                    "clearance",
                    format!("{}: {least_mm:.2} mm at tick {}", structure.name, structure.tick),
                ));
            }
            rows.extend(structure.removed_text().map(|removed| ("removed", removed)));
        }
        rows
    }

    fn timing_rows(&self) -> Rows {
        let quantiles = |q: &Quantiles| {
            format!("p50 {:.1}  p99 {:.1}  p99.9 {:.1}  max {:.1} us", q.p50, q.p99, q.p99_9, q.max)
        };
        let mut rows = Rows::new();
        if let Some(q) = &self.timing.step_us {
            rows.push(("step", quantiles(q)));
        }
        if let Some(q) = &self.timing.lateness_us {
            rows.push(("lateness", format!("{}, {} missed ticks", quantiles(q), self.timing.missed_ticks)));
        }
        if let Some(causes) = self.timing.misses.describe() {
            rows.push(("late due to", causes));
        }
        for (name, q) in &self.timing.round_trip_us {
            rows.push(("round trip", format!("{}, {name}", quantiles(q))));
        }
        rows
    }

    fn log_rows(&self) -> Rows {
        let mut rows = Rows::new();
        let megabytes = |bytes: u64| format!("{:.1} MB", bytes as f64 * 1e-6);
        let rate =
            self.logs.mb_per_simulated_s.map_or(String::new(), |mb| format!(", {mb:.2} MB per simulated s"));
        let (run, timing) = (megabytes(self.logs.run_bytes), megabytes(self.logs.timing_bytes));
        rows.push(("logs", format!("run {run}, timing {timing}{rate}")));
        if self.logs.first_tick > 0 {
            let first = self.logs.first_tick;
            rows.push((
                "kept",
                format!("from tick {first} on; except time and voxels, all numbers cover only that"),
            ));
        }
        rows.extend(self.logs.fmus.iter().map(|note| ("FMUs", note.clone())));
        match &self.logs.saved[..] {
            [] => {}
            [first, .., last] if self.logs.saved.len() > 4 => {
                rows.push(("saved", format!("{} logs, {first} to {last}", self.logs.saved.len())));
            }
            few => rows.push(("saved", few.join(", "))),
        }
        // Shared memory is counted in every process that maps it, so show private memory.
        let own = self
            .peak_memory_bytes
            .iter()
            .filter_map(|(name, &bytes)| Some((name.strip_suffix(NOT_SHARED)?, bytes)));
        let own: Vec<String> = own.map(|(name, bytes)| format!("{name} {}", megabytes(bytes))).collect();
        if !own.is_empty() {
            rows.push(("own memory", own.join(", ")));
        }
        if !self.events.is_empty() {
            let each = self.events.iter().map(|(name, count)| format!("{count} {name}"));
            rows.push(("events", each.collect::<Vec<_>>().join(", ")));
        }
        if let Some(warning) = self.warnings.last() {
            rows.push(("last warning", warning.clone()));
        }
        if let Some(ticks) = self.logs.describe_missing() {
            rows.push(("missing", ticks));
        }
        let lost: u64 = self.logs.lost_messages.values().sum();
        let lost = (lost > 0).then(|| format!("{} lost", foreign_text::counted(lost, "message")));
        let problems: Vec<String> = self.logs.notes.iter().cloned().chain(lost).collect();
        if !problems.is_empty() {
            rows.push(("log problems", problems.join("; ")));
        }
        rows.push(("replay", self.replay_command.clone()));
        rows
    }
}

impl MissSummary {
    /// Returns `8 run queue, 4 stolen, 2 not recorded (99.1 % confirmed)`, or `None` without a miss.
    fn describe(&self) -> Option<String> {
        let mut causes: Vec<String> =
            self.by_cause.iter().map(|(name, count)| format!("{count} {name}")).collect();
        causes.extend((self.not_recorded > 0).then(|| format!("{} not recorded", self.not_recorded)));
        let share = self.confirmed_share.map(|share| format!(" ({:.1} % confirmed)", 100.0 * share));
        (!causes.is_empty()).then(|| causes.join(", ") + &share.unwrap_or_default())
    }
}
