//! A simulation's state as bytes, with which another process of the same build continues bit for bit.
//!
//! A keyframe holds the state for a reader that has the scene; packed bytes hold the scene as well, but of
//! its files only the volume's SHA-256. Both are untrusted: a checksum detects damage, every length is
//! checked, and what does not match the scene is refused.

use std::sync::Arc;

use controllers::MemoryError;
use foreign_text::{counted, foreign};
use messages::services::MAX_KEYFRAME_BYTES;
use messages::{Frame, Latched, Tick};
use recorder_proc::build_info;
use run_log::BuildInfo;
use serde::{Deserialize, Serialize};
use simulation::KeyframeError;
use xxhash_rust::xxh3::xxh3_64;
use zerocopy::{FromBytes, IntoBytes};

use crate::error::SimError;
use crate::shared::SharedScene;
use crate::simulator::{Drive, Driver, Sim, Snapshot};

/// Largest keyframe of the physics, in bytes.
const MAX_PHYSICS_BYTES: usize = 1 << 30;

/// What [`Sim::keyframe`] writes.
#[derive(Serialize, Deserialize)]
struct Keyframe<'b> {
    physics: &'b [u8],
    latched: Option<&'b [u8]>,
    /// What each controller remembers; `None` for those that the caller drives.
    memories: Vec<Option<Vec<u8>>>,
    drilled: Vec<u32>,
    frame: Option<(&'b [u8], Vec<u16>)>,
    frames_rendered: u64,
}

/// What [`Sim::packed`] writes, behind a checksum.
#[derive(Serialize, Deserialize)]
struct Packed<'b> {
    /// Version, target and compiler.
    build: (&'b str, &'b str, &'b str),
    scene_toml: &'b str,
    notes: Vec<String>,
    volume_sha256: Option<[u8; 32]>,
    driven: Vec<String>,
    keyframe: &'b [u8],
    /// Keyframe to which a reset returns; `None` for tick 0.
    start: Option<&'b [u8]>,
}

/// Length of the checksum, XXH3-64, in bytes.
const CHECKSUM: usize = size_of::<u64>();

impl Sim {
    /// Returns the present state as bytes, for another process with this build and scene. Their number grows
    /// with what has been drilled.
    ///
    /// # Errors
    /// Drilling has touched too many voxels: the physics has more than 1 GiB.
    pub fn keyframe(&self) -> Result<Vec<u8>, SimError> {
        let failed =
            |cause: KeyframeError| SimError::Physics { tick: Tick(self.state().tick), cause: cause.into() };
        let mut physics = vec![0; MAX_KEYFRAME_BYTES];
        let length = loop {
            match self.run.plant().write_keyframe(&mut physics) {
                Err(KeyframeError::TooLong { .. }) if physics.len() < MAX_PHYSICS_BYTES => {
                    physics = vec![0; 2 * physics.len()];
                }
                other => break other.map_err(failed)?,
            }
        };
        let memory = |driver: &Driver| -> Result<Option<Vec<u8>>, MemoryError> {
            driver.built_in.as_ref().map(|built_in| built_in.memory()).transpose()
        };
        let memories: Result<_, MemoryError> = self.drivers.iter().map(memory).collect();
        let keyframe = Keyframe {
            physics: &physics[..length],
            latched: self.latched.as_deref().map(Latched::as_bytes),
            memories: memories.map_err(|cause| SimError::Packed(cause.to_string()))?,
            drilled: self.drilled.clone(),
            frame: self.frame.as_deref().map(|(frame, pixels)| (frame.as_bytes(), pixels.clone())),
            frames_rendered: self.frames_rendered,
        };
        written(&keyframe)
    }

    /// Moves to the state of [`Sim::keyframe`], from a simulation of the same scene in this or another
    /// process, and continues from there bit for bit.
    ///
    /// # Errors
    /// If the bytes are of another scene or build or are damaged; or this simulation is being recorded.
    /// Nothing has changed then.
    pub fn restore_keyframe(&mut self, bytes: &[u8]) -> Result<(), SimError> {
        let keyframe: Keyframe = read(bytes)?;
        let here = self.snapshot();
        let start = self.start.clone().unwrap_or_else(|| here.clone());
        self.restore(&start)?;
        let continued = self.continue_from(&keyframe);
        if continued.is_err() {
            self.restore(&here)?;
        }
        continued
    }

    fn continue_from(&mut self, keyframe: &Keyframe) -> Result<(), SimError> {
        let malformed = |what: &str| SimError::Packed(format!("malformed {what}"));
        let other = |what: &str| SimError::Packed(format!("{what} of another scene"));
        let latched = keyframe.latched.map(Latched::read_from_bytes).transpose();
        let latched = latched.map_err(|_| malformed("commands"))?.map(Box::new);
        let drives_alike =
            |(driver, memory): (&Driver, &Option<Vec<u8>>)| driver.built_in.is_some() == memory.is_some();
        if self.drivers.len() != keyframe.memories.len()
            || !self.drivers.iter().zip(&keyframe.memories).all(drives_alike)
        {
            return Err(other("the controllers are those"));
        }
        self.run.plant_mut().restore_keyframe(keyframe.physics).map_err(SimError::StateVector)?;
        let predrilled = self.run.plant().predrilled().to_vec();
        let mut gone = self.run.plant().gone();
        gone.retain(|voxel| predrilled.binary_search(voxel).is_err());
        let mut drilled = keyframe.drilled.clone();
        drilled.sort_unstable();
        gone.sort_unstable();
        if drilled != gone {
            return Err(other("the drilled voxels are those"));
        }
        for (driver, memory) in self.drivers.iter_mut().zip(&keyframe.memories) {
            if let (Some(built_in), Some(memory)) = (&mut driver.built_in, memory) {
                built_in.recall(memory).map_err(|cause| SimError::Packed(cause.to_string()))?;
            }
        }
        self.frame = match &keyframe.frame {
            None => None,
            Some((frame, pixels)) => {
                let frame = Frame::read_from_bytes(frame).map_err(|_| malformed("frame"))?;
                let expected = u64::from(frame.geometry.columns) * u64::from(frame.geometry.rows);
                if expected != pixels.len() as u64 {
                    return Err(malformed("frame"));
                }
                Some(Arc::new((frame, pixels.clone())))
            }
        };
        if let Some(latched) = &latched {
            self.run.follow(latched);
        }
        self.latched = latched;
        self.drilled.clone_from(&keyframe.drilled);
        self.frames_rendered = keyframe.frames_rendered;
        Ok(())
    }

    /// Returns scene and present state as bytes, for [`Sim::of_packed`] in another process with this build.
    /// The files that the scene names must be there as well; recordings are not continued.
    ///
    /// # Errors
    /// As [`Sim::keyframe`].
    pub fn packed(&self) -> Result<Vec<u8>, SimError> {
        let start = self.start.as_ref().filter(|start| start.state().tick != Tick::START.0);
        let start = start.map(|start| start.sim()?.keyframe()).transpose()?;
        pack(&self.shared, &self.driven(), &self.keyframe()?, start.as_deref())
    }

    /// Creates the simulation of [`Sim::packed`] or [`Snapshot::packed`].
    ///
    /// # Errors
    /// If the bytes are damaged or of another build; if the scene's volume or a file is missing or has
    /// changed.
    pub fn of_packed(bytes: &[u8]) -> Result<Sim, SimError> {
        let damaged = || SimError::Packed("damaged, or not a simulation of trabecula".to_owned());
        let (checksum, rest) = bytes.split_at_checked(CHECKSUM).ok_or_else(damaged)?;
        if checksum != xxh3_64(rest).to_le_bytes() {
            return Err(damaged());
        }
        // Another build may write other fields, so the build is read first.
        let (build, _): ((&str, &str, &str), _) = postcard::take_from_bytes(rest).map_err(|_| damaged())?;
        let current = build_info::current();
        if build != of_build(&current) {
            return Err(SimError::Packed(format!(
                "packed by another build ({} for {}), this is {} for {}; use the build that packed it",
                foreign(build.0),
                foreign(build.1),
                current.version,
                current.target
            )));
        }
        let packed: Packed = read(rest)?;
        let shared = SharedScene::of_packed(packed.scene_toml, packed.notes, packed.volume_sha256)?;
        let mut sim = Sim::new(&shared, &Drive::These(packed.driven))?;
        if let Some(start) = packed.start {
            sim.restore_keyframe(start)?;
            sim.starts_here();
        }
        sim.restore_keyframe(packed.keyframe)?;
        Ok(sim)
    }
}

impl Snapshot {
    /// Returns the snapshot and its scene as bytes, for [`Snapshot::of_packed`] in another process with this
    /// build.
    ///
    /// # Errors
    /// As [`Sim::packed`].
    pub fn packed(&self) -> Result<Vec<u8>, SimError> {
        let sim = self.sim()?;
        pack(&self.0.shared, &sim.driven(), &sim.keyframe()?, None)
    }

    /// Recreates the snapshot of [`Snapshot::packed`] or [`Sim::packed`].
    ///
    /// # Errors
    /// As [`Sim::of_packed`].
    pub fn of_packed(bytes: &[u8]) -> Result<Snapshot, SimError> {
        Ok(Sim::of_packed(bytes)?.snapshot())
    }

    /// Creates a simulation in this state.
    fn sim(&self) -> Result<Sim, SimError> {
        let mut sim = Sim::at_start(&self.0.shared, self.0.drivers.clone())?;
        sim.restore(self)?;
        Ok(sim)
    }
}

fn pack(
    shared: &SharedScene,
    driven: &[String],
    keyframe: &[u8],
    start: Option<&[u8]>,
) -> Result<Vec<u8>, SimError> {
    let build = build_info::current();
    let packed = written(&Packed {
        build: of_build(&build),
        scene_toml: &shared.toml()?,
        notes: shared.notes().to_vec(),
        volume_sha256: shared.ct().map(|ct| ct.sha256),
        driven: driven.to_vec(),
        keyframe,
        start,
    })?;
    Ok([&xxh3_64(&packed).to_le_bytes(), packed.as_slice()].concat())
}

fn of_build(build: &BuildInfo) -> (&str, &str, &str) {
    (&build.version, &build.target, build.rustc.as_deref().unwrap_or_default())
}

fn written(content: &impl Serialize) -> Result<Vec<u8>, SimError> {
    postcard::to_stdvec(content).map_err(|cause| SimError::Packed(cause.to_string()))
}

/// Reads exactly these bytes.
fn read<'b, T: Deserialize<'b>>(bytes: &'b [u8]) -> Result<T, SimError> {
    match postcard::take_from_bytes(bytes) {
        Ok((read, [])) => Ok(read),
        Ok((_, rest)) => {
            Err(SimError::Packed(format!("malformed: {} too many", counted(rest.len(), "byte"))))
        }
        Err(cause) => Err(SimError::Packed(format!("malformed ({cause})"))),
    }
}
