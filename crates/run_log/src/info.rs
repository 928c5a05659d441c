//! `info` — summarizes a log on one screen.

use std::collections::BTreeMap;
use std::io::Write;

use foreign_text::{counted, foreign, foreign_line};
use messages::Tick;

use crate::end::{Ending, hash_text};
use crate::error::LogError;
use crate::header::{LogHeader, RunMode};
use crate::misses::Misses;
use crate::source::LogSource;
use crate::stream::{MessageStream, ReadOptions, TopicCount};
use crate::verdict::Verdict;

/// Summary of a log.
#[derive(Debug)]
pub struct LogInfo {
    /// The log's header.
    pub header: LogHeader,
    /// Its metadata record.
    pub metadata: BTreeMap<String, String>,
    /// Messages and bytes by topic.
    pub topics: BTreeMap<String, TopicCount>,
    /// Latest simulated time of a message.
    pub end_ns: u64,
    /// Readable bytes of the file.
    pub file_bytes: u64,
    /// Ticks that began late; timing lane only.
    pub misses: Misses,
    /// How the file ends.
    pub ending: Ending,
    /// The damage that stopped reading, if any.
    pub log_error: Option<LogError>,
    /// The log's faults.
    pub verdict: Verdict,
}

/// Reads a whole log of either lane and summarizes it. Damage is reported in the summary, not as an error.
pub fn info(log: &dyn LogSource, options: ReadOptions) -> Result<LogInfo, LogError> {
    let mut stream = MessageStream::open(log, options)?;
    let (mut end_ns, mut misses) = (0, Misses::from_tick(stream.header().first_tick));
    let log_error = loop {
        match stream.next_message() {
            Ok(Some(message)) => {
                end_ns = message.log_time_ns.max(end_ns);
                misses.take(message.known, message.body);
            }
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    Ok(LogInfo {
        header: stream.header().clone(),
        metadata: stream.metadata().clone(),
        topics: stream.counts(),
        end_ns,
        file_bytes: stream.offset(),
        misses,
        ending: stream.ending().clone(),
        log_error,
        verdict: stream.verdict(),
    })
}

impl LogInfo {
    /// Returns the file's bytes per simulated second; `None` before the first tick.
    pub fn bytes_per_second(&self) -> Option<f64> {
        let first_ns = self.header.first_tick.0.saturating_mul(self.header.dt_ns);
        let length_ns = self.end_ns.saturating_sub(first_ns);
        (length_ns > 0).then(|| self.file_bytes as f64 / (length_ns as f64 * 1e-9))
    }

    /// Returns the number of missing messages of a topic: lost by the recorder plus lost to damage.
    pub fn lost(&self, topic: &str) -> u64 {
        let Some(marker) = &self.ending.marker else {
            return self.topics.get(topic).map_or(0, |count| count.missing);
        };
        marker.lost.get(topic).unwrap_or(&0) + marker.damaged.get(topic).unwrap_or(&0)
    }

    /// Writes why ticks began late, if this is the timing lane of a real-time run.
    pub fn write_misses(&self, out: &mut dyn Write) -> Result<(), LogError> {
        if self.misses.ticks > 0 && self.header.mode == RunMode::RealTime {
            writeln!(out, "late ticks  {}", self.misses.describe())?;
        }
        Ok(())
    }

    /// Writes the summary as text.
    pub fn write(&self, out: &mut dyn Write) -> Result<(), LogError> {
        let header = &self.header;
        let first_ns = header.first_tick.0.saturating_mul(header.dt_ns).min(self.end_ns);
        let (first_s, seconds) = (first_ns as f64 * 1e-9, (self.end_ns - first_ns) as f64 * 1e-9);
        let lane = self.metadata.get("lane").map(String::as_str).unwrap_or_default();
        writeln!(out, "scene       {} (sha256 {})", foreign(&header.scene_name), header.scene_sha256())?;
        match header.volume_sha256 {
            Some(digest) => {
                let [i, j, k] = header.volume_dimensions;
                writeln!(out, "volume      {i} x {j} x {k} (sha256 {})", messages::layout::hex(&digest))?;
            }
            None => writeln!(out, "volume      none")?,
        }
        let build = &header.build;
        let rustc = foreign(build.rustc.as_deref().unwrap_or("unknown compiler"));
        writeln!(out, "build       {} for {}, {rustc}", foreign(&build.version), foreign(&build.target))?;
        writeln!(
            out,
            "lane        {}, {}, controllers: {}",
            foreign(lane),
            header.mode.name(),
            foreign_line(&header.controllers.join(", "))
        )?;
        let ticks = (self.end_ns - first_ns) / header.dt_ns.max(1);
        let from = match header.first_tick {
            Tick::START => String::new(),
            tick => format!(", from the keyframe of tick {tick} ({first_s:.3} s)"),
        };
        writeln!(
            out,
            "duration    {seconds:.3} s simulated, {} of {} us{from}",
            counted(ticks, "tick"),
            header.dt_ns as f64 * 1e-3
        )?;
        let rate = self.bytes_per_second().unwrap_or(0.0);
        writeln!(out, "size        {} bytes, {rate:.0} bytes per simulated second", self.file_bytes)?;
        for (topic, count) in &self.topics {
            let lost = self.lost(topic);
            let gap = if lost > 0 { format!("  {lost} MISSING") } else { String::new() };
            writeln!(
                out,
                "  {:<22} {:>10} messages {:>14} bytes unpacked{gap}",
                foreign(topic),
                count.messages,
                count.bytes
            )?;
        }
        self.write_misses(out)?;
        writeln!(out, "end         {}", self.ending.describe())?;
        if let Some(marker) = &self.ending.marker {
            let tick = marker.last_tick.map_or("none".to_string(), |tick| tick.to_string());
            let hash = marker.hash.map(hash_text).unwrap_or_else(|| "none".to_string());
            writeln!(out, "  last tick {tick}, hash {hash}")?;
            for (topic, count) in &marker.lost {
                let (lost, topic) = (counted(count, "message"), foreign(topic));
                writeln!(out, "  lost {lost} of {topic}: never reached the log")?;
            }
            for (topic, count) in &marker.damaged {
                let (lost, topic) = (counted(count, "message"), foreign(topic));
                writeln!(out, "  lost {lost} of {topic} to damage of the file")?;
            }
        }
        self.verdict.write(out)
    }
}
