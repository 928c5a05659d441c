//! Simulations on separate threads.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvError, RecvTimeoutError, Sender, TryRecvError, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use messages::{Command, State};

use crate::error::SimError;
use crate::linear::LinearModel;
use crate::shared::SharedScene;
use crate::simulator::{Drive, Sim, Snapshot};

/// Creates a simulation on the thread that will hold it.
pub type SimFactory = Box<dyn FnOnce() -> Result<Sim, SimError> + Send>;

type Job = Box<dyn FnOnce(&mut [Held]) + Send>;

/// A simulation with its index.
struct Held {
    index: usize,
    sim: Sim,
}

/// Simulations that are stepped together. A thread creates its simulations, holds them and steps each of them
/// whole, so the number of threads does not change a bit. They never leave it, because the arm's trajectories
/// are C++ objects (Ruckig) that belong to one thread.
pub struct Batch {
    workers: Vec<Worker>,
    count: usize,
    driven: Vec<String>,
    /// Process that the threads belong to: a forked child has none of them.
    process: u32,
}

struct Worker {
    jobs: Option<Sender<Job>>,
    thread: Option<JoinHandle<()>>,
}

impl Batch {
    /// Creates one simulation of each scene, on this many threads; 0 selects the number of cores.
    ///
    /// # Errors
    /// As [`Sim::new`]; also if the threads cannot be started.
    pub fn new(scenes: &[Arc<SharedScene>], drive: &Drive, threads: usize) -> Result<Batch, SimError> {
        let maker = |scene: &Arc<SharedScene>| -> SimFactory {
            let (scene, drive) = (Arc::clone(scene), drive.clone());
            Box::new(move || Sim::new(&scene, &drive))
        };
        Batch::of(scenes.iter().map(maker).collect(), threads)
    }

    /// Creates one simulation with each of these makers.
    ///
    /// # Errors
    /// As [`Batch::new`].
    pub fn of(makers: Vec<SimFactory>, threads: usize) -> Result<Batch, SimError> {
        Batch::of_watched(makers, threads, &mut || ())
    }

    /// As [`Batch::of`]; calls `look` every 50 ms while the simulations are being created.
    ///
    /// # Errors
    /// As [`Batch::of`].
    pub fn of_watched(
        makers: Vec<SimFactory>,
        threads: usize,
        look: &mut dyn FnMut(),
    ) -> Result<Batch, SimError> {
        let count = makers.len();
        let cores = || std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let threads = if threads == 0 { cores() } else { threads };
        let mut parts: Vec<Vec<(usize, SimFactory)>> = Vec::new();
        parts.resize_with(threads.min(count).max(1), Vec::new);
        let workers = parts.len();
        for (index, maker) in makers.into_iter().enumerate() {
            parts[index % workers].push((index, maker));
        }
        let (made, is_made) = channel();
        let start = |(number, part)| Worker::start(number, part, made.clone());
        let started: std::io::Result<Vec<Worker>> = parts.into_iter().enumerate().map(start).collect();
        let failed = |cause: std::io::Error| SimError::Threads { threads, reason: cause.to_string() };
        let workers = started.map_err(failed)?;
        drop(made);
        for _ in &workers {
            received_watched(&is_made, look).map_err(|_| SimError::Gone)??;
        }
        let mut batch = Batch { workers, count, driven: Vec::new(), process: std::process::id() };
        if count > 0 {
            batch.driven = batch.with(0, |sim| Ok(sim.driven()))?;
        }
        Ok(batch)
    }

    /// Returns the number of simulations.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Returns the number of threads, which never exceeds the number of simulations.
    pub fn threads(&self) -> usize {
        self.workers.len()
    }

    /// Returns the names of the controllers that the caller drives in each simulation.
    pub fn driven(&self) -> &[String] {
        &self.driven
    }

    /// Runs `work` with one simulation.
    ///
    /// # Errors
    /// If no simulation has this index or the process was forked; errors of `work`.
    pub fn with<R: Send + 'static>(
        &self,
        index: usize,
        work: impl FnOnce(&mut Sim) -> Result<R, SimError> + Send + 'static,
    ) -> Result<R, SimError> {
        self.with_watched(index, work, &mut || ())
    }

    /// As [`Batch::with`]; calls `look` every 50 ms while it waits.
    ///
    /// # Errors
    /// As [`Batch::with`].
    pub fn with_watched<R: Send + 'static>(
        &self,
        index: usize,
        work: impl FnOnce(&mut Sim) -> Result<R, SimError> + Send + 'static,
        look: &mut dyn FnMut(),
    ) -> Result<R, SimError> {
        let none = SimError::NoSimulation { index, count: self.count };
        if index >= self.count {
            return Err(none);
        }
        let worker = index % self.workers.len();
        let answer = self.ask(worker, move |held| {
            held.iter_mut().find(|held| held.index == index).map(|held| work(&mut held.sim))
        })?;
        received_watched(&answer, look).map_err(|_| SimError::Gone)?.unwrap_or(Err(none))
    }

    /// Steps every simulation by `ticks` ticks and returns their states, in order. `commands` holds those of
    /// the first simulation, then those of the second and so on, each as for [`Sim::step`]; with `None`, the
    /// driven controllers send empty commands.
    ///
    /// # Errors
    /// [`SimError::Count`] for too few or too many commands; nothing has changed then. Otherwise the error of
    /// the first simulation, in their order, that has one; the others have completed their ticks.
    pub fn step(&self, commands: Option<Vec<Command>>, ticks: u64) -> Result<Vec<State>, SimError> {
        self.step_watched(commands, ticks, &mut || false)
    }

    /// As [`Batch::step`]. While it waits it calls `is_to_end` every 50 ms; once that returns true, no
    /// simulation runs a further tick, and each stays at the tick it has reached.
    ///
    /// # Errors
    /// As [`Batch::step`].
    pub fn step_watched(
        &self,
        commands: Option<Vec<Command>>,
        ticks: u64,
        is_to_end: &mut dyn FnMut() -> bool,
    ) -> Result<Vec<State>, SimError> {
        let (driven, commands) = (self.driven.len(), self.commands_of_each(commands)?);
        let ended = Arc::new(AtomicBool::new(false));
        let is_ended = Arc::clone(&ended);
        let work = move |index: usize, sim: &mut Sim| {
            sim.step_until(&commands[index * driven..(index + 1) * driven], ticks, &is_ended)?;
            Ok(*sim.state())
        };
        self.each_watched(work, &mut || {
            if is_to_end() {
                ended.store(true, Ordering::Relaxed);
            }
        })
    }

    /// Returns the states, in order.
    ///
    /// # Errors
    /// If the process was forked.
    pub fn states(&self) -> Result<Vec<State>, SimError> {
        self.each(|_, sim| Ok(*sim.state()))
    }

    /// Restores a snapshot in every simulation: the same in all, or a separate one in each.
    ///
    /// # Errors
    /// As [`Sim::restore`], if any of them refuses its snapshot; then none has changed. Also if there is not
    /// one snapshot for each.
    pub fn restore(&self, snapshots: Vec<Snapshot>) -> Result<(), SimError> {
        let (given, expected) = (snapshots.len(), self.count);
        if given != 1 && given != expected {
            return Err(SimError::Count { what: "snapshots", given, expected });
        }
        let snapshots = Arc::new(snapshots);
        let offered = Arc::clone(&snapshots);
        self.each(move |index, sim| sim.refuse_unfit(&offered[index.min(given - 1)]))?;
        self.each(move |index, sim| sim.restore(&snapshots[index.min(given - 1)])).map(|_| ())
    }

    /// Linearises the next tick of every simulation at its present state, each as [`Sim::linearize`] does;
    /// `commands` is as for [`Batch::step`].
    ///
    /// # Errors
    /// As [`Batch::step`] and [`Sim::linearize`].
    pub fn linearize_watched(
        &self,
        commands: Option<Vec<Command>>,
        inputs: &[String],
        outputs: &[String],
        look: &mut dyn FnMut(),
    ) -> Result<Vec<LinearModel>, SimError> {
        let (driven, commands) = (self.driven.len(), self.commands_of_each(commands)?);
        let (inputs, outputs) = (inputs.to_vec(), outputs.to_vec());
        let work = move |index: usize, sim: &mut Sim| {
            sim.linearize(&commands[index * driven..(index + 1) * driven], &inputs, &outputs)
        };
        self.each_watched(work, look)
    }

    /// Returns the commands of each simulation, empty ones if none are given.
    fn commands_of_each(&self, commands: Option<Vec<Command>>) -> Result<Vec<Command>, SimError> {
        let expected = self.driven.len() * self.count;
        match commands {
            Some(given) if given.len() != expected => {
                Err(SimError::Count { what: "commands", given: given.len(), expected })
            }
            given => Ok(given.unwrap_or_else(|| vec![Command::zeroed(); expected])),
        }
    }

    /// Resets the simulations whose flag is true.
    ///
    /// # Errors
    /// As [`Sim::reset`]; also if there is not one flag for each.
    pub fn reset(&self, which: Vec<bool>) -> Result<(), SimError> {
        if which.len() != self.count {
            return Err(SimError::Count { what: "flags", given: which.len(), expected: self.count });
        }
        self.each(move |index, sim| if which[index] { sim.reset() } else { Ok(()) }).map(|_| ())
    }

    /// Runs `work` with every simulation at once; the results are in their order.
    fn each<R: Send + 'static>(
        &self,
        work: impl Fn(usize, &mut Sim) -> Result<R, SimError> + Send + Sync + 'static,
    ) -> Result<Vec<R>, SimError> {
        self.each_watched(work, &mut || ())
    }

    /// As `each`; calls `look` every 50 ms while it waits.
    fn each_watched<R: Send + 'static>(
        &self,
        work: impl Fn(usize, &mut Sim) -> Result<R, SimError> + Send + Sync + 'static,
        look: &mut dyn FnMut(),
    ) -> Result<Vec<R>, SimError> {
        let work = Arc::new(work);
        let ask = |worker| {
            let work = Arc::clone(&work);
            self.ask(worker, move |held: &mut [Held]| -> Vec<(usize, Result<R, SimError>)> {
                held.iter_mut().map(|held| (held.index, work(held.index, &mut held.sim))).collect()
            })
        };
        let asked: Vec<_> = (0..self.workers.len()).map(ask).collect::<Result<_, _>>()?;
        let mut done = Vec::with_capacity(self.count);
        for answer in asked {
            done.extend(received_watched(&answer, look).map_err(|_| SimError::Gone)?);
        }
        done.sort_by_key(|(index, _)| *index);
        done.into_iter().map(|(_, result)| result).collect()
    }

    fn ask<R: Send + 'static>(
        &self,
        worker: usize,
        work: impl FnOnce(&mut [Held]) -> R + Send + 'static,
    ) -> Result<Receiver<R>, SimError> {
        if self.process != std::process::id() {
            return Err(SimError::Forked);
        }
        let (answer, answered) = channel();
        let jobs = self.workers.get(worker).and_then(|worker| worker.jobs.as_ref()).ok_or(SimError::Gone)?;
        let job: Job = Box::new(move |held| _ = answer.send(work(held)));
        jobs.send(job).map_err(|_| SimError::Gone)?;
        Ok(answered)
    }
}

/// Number of polls for another thread's message before sleeping, some 50 microseconds in all: a caller that
/// runs tick after tick would wait longer for a sleeping thread to wake than for the tick.
const LOOKS: u32 = 1000;

/// Polls for a message of the other thread; `None` if there is none yet.
fn received_soon<T>(from: &Receiver<T>) -> Result<Option<T>, RecvError> {
    for _ in 0..LOOKS {
        match from.try_recv() {
            Ok(sent) => return Ok(Some(sent)),
            Err(TryRecvError::Disconnected) => return Err(RecvError),
            Err(TryRecvError::Empty) => core::hint::spin_loop(),
        }
    }
    Ok(None)
}

/// Waits for the other thread's message.
fn received<T>(from: &Receiver<T>) -> Result<T, RecvError> {
    received_soon(from)?.map_or_else(|| from.recv(), Ok)
}

/// Time between calls of `look` during a long wait.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Waits for the other thread's message; calls `look` meanwhile.
fn received_watched<T>(from: &Receiver<T>, look: &mut dyn FnMut()) -> Result<T, RecvError> {
    if let Some(sent) = received_soon(from)? {
        return Ok(sent);
    }
    loop {
        match from.recv_timeout(LOOK_EVERY) {
            Ok(sent) => return Ok(sent),
            Err(RecvTimeoutError::Disconnected) => return Err(RecvError),
            Err(RecvTimeoutError::Timeout) => look(),
        }
    }
}

impl Drop for Batch {
    fn drop(&mut self) {
        self.workers.iter_mut().for_each(|worker| worker.jobs = None);
        // A forked child has no thread to wait for.
        if self.process == std::process::id() {
            let threads = self.workers.iter_mut().filter_map(|worker| worker.thread.take());
            threads.for_each(|thread| _ = thread.join());
        }
    }
}

impl Worker {
    fn start(
        number: usize,
        part: Vec<(usize, SimFactory)>,
        made: Sender<Result<(), SimError>>,
    ) -> std::io::Result<Worker> {
        let (jobs, to_do) = channel::<Job>();
        let work = move || {
            let make = |(index, make): (usize, SimFactory)| make().map(|sim| Held { index, sim });
            let sims: Result<Vec<Held>, SimError> = part.into_iter().map(make).collect();
            let (told, sims) = match sims {
                Ok(sims) => (Ok(()), sims),
                Err(error) => (Err(error), Vec::new()),
            };
            _ = made.send(told);
            drop(made);
            let mut sims = sims;
            while let Ok(job) = received(&to_do) {
                job(&mut sims);
            }
        };
        let thread = std::thread::Builder::new().name(format!("sim-{number}")).spawn(work)?;
        Ok(Worker { jobs: Some(jobs), thread: Some(thread) })
    }
}
