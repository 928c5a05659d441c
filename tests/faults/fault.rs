//! Faults that can occur in the middle of a run, and their permitted outcomes.

/// A process of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Victim {
    Physics,
    Drr,
    Recorder,
    /// The built-in controller `reference`.
    Controller,
    Launcher,
    /// The external controller `guest`, which the run does not wait for.
    Client,
}

impl Victim {
    pub const ALL: [Victim; 6] = [
        Victim::Physics,
        Victim::Drr,
        Victim::Recorder,
        Victim::Controller,
        Victim::Launcher,
        Victim::Client,
    ];

    /// The name in `trabecula proc`; a client has none.
    pub fn part(self) -> &'static str {
        match self {
            Victim::Physics => "physics",
            Victim::Drr => "drr",
            Victim::Recorder => "recorder",
            Victim::Controller => "controller",
            Victim::Launcher => "launcher",
            Victim::Client => "client",
        }
    }

    /// The name used by the launcher.
    fn name(self) -> &'static str {
        match self {
            Victim::Controller => "reference",
            Victim::Client => "guest",
            other => other.part(),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// SIGKILL.
    Kill(Victim),
    /// SIGSTOP for two seconds.
    Stop(Victim),
    /// For a second it runs only a fifth of the time, by SIGSTOP and SIGCONT.
    Starve(Victim),
    /// A client that reads a state every 100 ms.
    SlowReader,
    /// A client that sends commands as fast as it can.
    Flood,
    /// A client that sends random bytes of random lengths to every service that it may write.
    Garbage,
    /// A client that is killed while it fills a command in shared memory.
    LoanDeath,
    /// Clients that are killed while they join, followed by one that joins.
    JoinDeath,
    /// The controller awaited at the start is killed while it joins; then it joins again.
    AwaitedJoinDeath,
    /// /dev/shm lacks the room that a session needs.
    MemoryFullAtStart,
    /// /dev/shm is full, and a client joins.
    MemoryFull,
    /// The disk of the log is full.
    DiskFull,
    /// The log reaches the recorder's file size limit.
    FileLimit,
    /// Every process of a run is killed at once; the next run cleans up.
    AllKilled,
    /// A second hub runs concurrently, and its parts are killed.
    TwoHubs,
    /// The wall clock of every process steps by an hour back and forth, ten times per second.
    ClockStep,
    /// Clients of another version.
    OtherVersion,
}

/// Permitted outcomes of a fault.
#[derive(Debug, Clone, Copy)]
pub struct Allowed {
    /// The run may continue.
    pub goes_on: bool,
    /// The run may end with an error that contains one of these texts.
    pub errors: [&'static str; 2],
}

/// No error contains this text.
const NEVER: &str = "\0";

impl Fault {
    pub fn all() -> Vec<Fault> {
        let mut all = Vec::new();
        for victim in Victim::ALL {
            all.extend([Fault::Kill(victim), Fault::Stop(victim), Fault::Starve(victim)]);
        }
        all.extend([
            Fault::SlowReader,
            Fault::Flood,
            Fault::Garbage,
            Fault::LoanDeath,
            Fault::JoinDeath,
            Fault::AwaitedJoinDeath,
            Fault::MemoryFullAtStart,
            Fault::MemoryFull,
            Fault::DiskFull,
            Fault::FileLimit,
            Fault::AllKilled,
            Fault::TwoHubs,
            Fault::ClockStep,
            Fault::OtherVersion,
        ]);
        all
    }

    pub fn name(self) -> String {
        match self {
            Fault::Kill(victim) => format!("kill -9 {}", victim.part()),
            Fault::Stop(victim) => format!("SIGSTOP 2 s {}", victim.part()),
            Fault::Starve(victim) => format!("starve {}", victim.part()),
            Fault::SlowReader => "client reads slowly".to_owned(),
            Fault::Flood => "client floods".to_owned(),
            Fault::Garbage => "client sends garbage".to_owned(),
            Fault::LoanDeath => "client dies holding a loan".to_owned(),
            Fault::JoinDeath => "client dies joining".to_owned(),
            Fault::AwaitedJoinDeath => "awaited client dies joining".to_owned(),
            Fault::MemoryFullAtStart => "/dev/shm full at the start".to_owned(),
            Fault::MemoryFull => "/dev/shm full, client joins".to_owned(),
            Fault::DiskFull => "disk full".to_owned(),
            Fault::FileLimit => "file size limit".to_owned(),
            Fault::AllKilled => "kill -9 all, stale session".to_owned(),
            Fault::TwoHubs => "two hubs, one killed".to_owned(),
            Fault::ClockStep => "wall clock steps".to_owned(),
            Fault::OtherVersion => "client of another version".to_owned(),
        }
    }

    /// Returns the permitted outcomes.
    pub fn allowed(self, lockstep: bool) -> Allowed {
        // In lockstep every tick waits for every controller; if one is silent, the run ends and names it.
        let silent = |name: &'static str| Allowed {
            goes_on: true,
            errors: [if lockstep { name } else { NEVER }, NEVER],
        };
        let goes_on = Allowed { goes_on: true, errors: [NEVER; 2] };
        match self {
            Fault::Kill(Victim::Client) | Fault::LoanDeath => silent("controller `guest` did not answer"),
            Fault::Kill(Victim::Launcher) | Fault::AllKilled => {
                Allowed { goes_on: false, errors: [NEVER; 2] }
            }
            Fault::Kill(victim) => {
                let death = match victim.name() {
                    "physics" => "part `physics` died (signal: 9",
                    "drr" => "part `drr` died (signal: 9",
                    "recorder" => "part `recorder` died (signal: 9",
                    _ => "part `reference` died (signal: 9",
                };
                Allowed { goes_on: false, errors: [death, NEVER] }
            }
            // In lockstep the controller waits for frames.
            Fault::Stop(Victim::Controller | Victim::Drr)
            | Fault::Starve(Victim::Controller | Victim::Drr) => {
                silent("controller `reference` did not answer")
            }
            Fault::Stop(Victim::Client) | Fault::Starve(Victim::Client) | Fault::SlowReader => {
                silent("controller `guest` did not answer")
            }
            Fault::MemoryFullAtStart => Allowed { goes_on: true, errors: ["/dev/shm", NEVER] },
            Fault::DiskFull => Allowed {
                goes_on: false,
                errors: ["cannot write the log: No space left", "cannot be written (No space left"],
            },
            Fault::FileLimit => {
                Allowed { goes_on: false, errors: ["cannot write the log: File too large", NEVER] }
            }
            _ => goes_on,
        }
    }

    /// Returns whether the guest takes part from the start.
    pub fn needs_guest(self) -> bool {
        matches!(
            self,
            Fault::Kill(Victim::Client) | Fault::Stop(Victim::Client) | Fault::Starve(Victim::Client)
        )
    }

    /// Returns whether another client may misbehave at the same time.
    pub fn may_have_company(self) -> bool {
        match self {
            Fault::Kill(victim) | Fault::Stop(victim) | Fault::Starve(victim) => victim != Victim::Client,
            Fault::FileLimit | Fault::AllKilled | Fault::TwoHubs | Fault::ClockStep => true,
            _ => false,
        }
    }
}
