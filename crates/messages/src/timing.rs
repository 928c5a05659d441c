use super::MAX_CONTROLLERS;
use crate::message;

message! {
    /// Wall-clock measurements of one tick. Recorded in the timing lane only, so that the run lane stays
    /// deterministic.
    pub struct TickTiming = "trabecula_msgs/msg/TickTiming" {
        /// k: the measured tick.
        tick: u64,
        /// Monotonic clock at the start of the tick.
        start_ns: u64,
        /// How long after its deadline the tick began (real time); 0 in lockstep.
        wake_lateness_ns: i64,
        /// Time spent latching: waiting for commands in lockstep, collecting them in real time.
        latch_ns: u64,
        /// Time spent in the physics step.
        step_ns: u64,
        /// Time spent hashing and publishing.
        publish_ns: u64,
        /// Time that this thread was runnable but waited for a core, from the start of the last tick to the
        /// start of this one; in lockstep from the publication of the last state to that of this tick's.
        run_queue_wait_ns: u64,
        /// Wall time of the last tick's work: from its start until the thread went to sleep for this one
        /// (real time).
        work_ns: u64,
        /// CPU time of this thread during that work, without time stolen by a hypervisor (real time).
        work_cpu_ns: u64,
        /// Time from this tick's deadline to the end of the last tick's work; negative if it ended before
        /// (real time).
        overrun_ns: i64,
        /// Time spent collecting the controllers' commands before this tick began (real time).
        collect_ns: u64,
        /// Steal time of this thread's core since the last reading, at most 100 ms earlier, in steps of 10
        /// ms. Read in late ticks only; 0 otherwise.
        stolen_ns: u64,
        /// Time that this process's control group was throttled because its CPU quota was used up
        /// (`cpu.stat`), since the last reading. Read only in ticks that begin more than 5 ms late; 0
        /// otherwise.
        throttled_ns: u64,
        /// Time that this process was stopped: frozen with its control group (`cgroup.stat.local`), since the
        /// last reading, read only in ticks that begin more than 5 ms late; or the whole lateness, if a
        /// SIGCONT ended a stop; 0 otherwise.
        stopped_ns: u64,
        /// Time past its deadline that this tick waited for the recorder (`recording.on_full = "wait"`, real
        /// time).
        recorder_wait_ns: u64,
        /// Time from publishing the state to receiving the command that answers it, per controller; 0 if none
        /// was received. In real time, commands are received when the next tick begins, so this is mostly the
        /// wait for that tick.
        round_trip_ns: [u64; MAX_CONTROLLERS],
        /// Page faults of this thread from the start of the last tick to the start of this one; in lockstep
        /// from the publication of the last state to that of this tick's.
        page_faults: u32,
        /// Page faults among them that waited for a disk.
        major_page_faults: u32,
        /// Voluntary context switches of the thread in that time; in real time it sleeps once per tick.
        voluntary_switches: u32,
        /// Involuntary context switches of the thread in that time.
        involuntary_switches: u32,
        /// 1 if this tick began more than one period late.
        missed: u32,
        /// Bit i: the command of controller i was late, so its last command or the safe command was applied.
        late_controllers: u32,
        /// 1 on a virtual machine.
        virtual_machine: u32,
        /// Always 0.
        reserved: u32,
    }
}

message! {
    /// Wall-clock measurements of one DRR frame. Recorded in the timing lane only.
    pub struct FrameTiming = "trabecula_msgs/msg/FrameTiming" {
        /// `Frame.sequence`.
        frame_sequence: u64,
        /// Tick that the frame shows.
        tick: u64,
        /// Time spent rendering.
        render_ns: u64,
        /// Rays traced through the volume.
        rays: u64,
        /// Ticks that the physics had advanced by the time the frame was published.
        age_ticks: u64,
        /// 1 if the whole image was traced, 0 if only the changed part.
        full: u32,
        /// Always 0.
        reserved: u32,
    }
}
