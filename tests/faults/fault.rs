//! What can happen in the middle of a run, and what may come of it.

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

    /// As `trabecula proc` calls it; a client is none.
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

    /// As the launcher calls it.
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
    /// For a second it may run a fifth of the time: SIGSTOP and SIGCONT.
    Starve(Victim),
    /// A client that takes a state every 100 ms.
    SlowReader,
    /// A client that sends commands as fast as it can.
    Flood,
    /// A client that sends random bytes of random lengths to every service it may write.
    Garbage,
    /// A client that is killed while it fills a command in shared memory.
    LoanDeath,
    /// Clients that are killed while they join, and one that joins then.
    JoinDeath,
    /// The controller that the start waits for is killed while it joins; then it comes.
    AwaitedJoinDeath,
    /// /dev/shm has not the room that a session needs.
    MemoryFullAtStart,
    /// /dev/shm is full, and a client joins.
    MemoryFull,
    /// The disk of the log is full.
    DiskFull,
    /// The log has reached the recorder's limit on the size of a file.
    FileLimit,
    /// Every process of a run is killed at once; the next run clears up.
    AllKilled,
    /// A second hub beside, whose parts are killed.
    TwoHubs,
    /// The wall clock steps by an hour to and fro, ten times a second, for every process.
    ClockStep,
    /// Clients of another version.
    OtherVersion,
}

/// What may come of a fault.
#[derive(Debug, Clone, Copy)]
pub struct Allowed {
    /// The run may go on.
    pub goes_on: bool,
    /// The run may end with an error that has one of these words.
    pub errors: [&'static str; 2],
}

/// No error has these words.
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

    /// What may come of it.
    pub fn allowed(self, lockstep: bool) -> Allowed {
        // In lockstep every tick waits for every controller; its silence ends the run and names it.
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

    /// Whether the guest takes part from the start.
    pub fn needs_guest(self) -> bool {
        matches!(
            self,
            Fault::Kill(Victim::Client) | Fault::Stop(Victim::Client) | Fault::Starve(Victim::Client)
        )
    }

    /// Whether another client may misbehave at the same time.
    pub fn may_have_company(self) -> bool {
        match self {
            Fault::Kill(victim) | Fault::Stop(victim) | Fault::Starve(victim) => victim != Victim::Client,
            Fault::FileLimit | Fault::AllKilled | Fault::TwoHubs | Fault::ClockStep => true,
            _ => false,
        }
    }
}
