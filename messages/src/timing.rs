use super::MAX_CONTROLLERS;
use crate::message;

message! {
    /// Wall-clock facts of one tick. Written to the timing lane only, so that the state lane stays deterministic.
    pub struct TickTiming = "trabecula_msgs/msg/TickTiming" {
        /// k: the tick that these facts are about.
        tick: u64,
        /// Monotonic clock when the tick began.
        start_ns: u64,
        /// How long after its deadline the tick began (real time); 0 in lockstep.
        wake_lateness_ns: i64,
        /// Time spent latching: waiting for commands in lockstep, collecting them in real time.
        latch_ns: u64,
        /// Time of the physics step alone.
        step_ns: u64,
        /// Time of hashing and publishing.
        publish_ns: u64,
        /// Time in which the kernel had this thread wait for a core, from the beginning of the last tick to that of this one.
        run_queue_wait_ns: u64,
        /// Wall time of the last tick's work: from its beginning until the thread went to sleep for this one (real time).
        work_ns: u64,
        /// Processor time of this thread in it, without what a hypervisor stole (real time).
        work_cpu_ns: u64,
        /// How long after this tick's deadline the last tick's work ended; negative: so long before (real time).
        overrun_ns: i64,
        /// Time of taking the controllers' commands before this tick began (real time).
        collect_ns: u64,
        /// Steal of the core that the thread is on, since it was looked at last, at most 100 ms before, in steps of 10 ms.
        /// It is looked at in late ticks only; 0 otherwise.
        stolen_ns: u64,
        /// How long the kernel held the control group of this process back because it had used up its quota (`cpu.stat`), since that
        /// was last looked at: in ticks that begin more than 5 ms late only; 0 otherwise.
        throttled_ns: u64,
        /// How long this process was stopped: frozen with its control group (`cgroup.stat.local`), since that was last looked at, in ticks
        /// that begin more than 5 ms late only; or all of the lateness, where a SIGCONT has ended a stop; 0 otherwise.
        stopped_ns: u64,
        /// How long behind its deadline this tick waited for the recorder (`recording.on_full = "wait"`, real time).
        recorder_wait_ns: u64,
        /// From the publication of the state until the command that answers it was taken, per controller; 0 if none came.
        /// In real time commands are taken when the next tick begins, so most of a period is waiting for that.
        round_trip_ns: [u64; MAX_CONTROLLERS],
        /// Page faults of this thread from the beginning of the last tick to that of this one.
        page_faults: u32,
        /// Those of them that waited for a disk.
        major_page_faults: u32,
        /// How often in this time the thread gave its core away by itself: it sleeps once a tick in real time.
        voluntary_switches: u32,
        /// How often its core was taken from it.
        involuntary_switches: u32,
        /// 1 if this tick began more than one period late.
        missed: u32,
        /// Bit i: the command of controller i was late, so that its last or the safe one held.
        late_controllers: u32,
        /// 1 if the machine is a virtual one.
        virtual_machine: u32,
        /// Always 0.
        reserved: u32,
    }
}

message! {
    /// Wall-clock facts of one DRR frame. Written to the timing lane only.
    pub struct FrameTiming = "trabecula_msgs/msg/FrameTiming" {
        /// `Frame.sequence`.
        frame_sequence: u64,
        /// Tick shown.
        tick: u64,
        /// Time of rendering.
        render_ns: u64,
        /// Rays traced through the volume.
        rays: u64,
        /// Ticks that the physics had gone on when the frame was out.
        age_ticks: u64,
        /// 1 if the whole image was traced, 0 if only what had changed.
        full: u32,
        /// Always 0.
        reserved: u32,
    }
}
