//! The recipe runner: from uploaded files to a refined model, its report and its pictures.

use serde_json::Value;

use super::options::{Options, Recipe, Stage, TextureFormat};
use super::pack;
use super::stage::Frame;
use super::textures::{self, BakedSlot};
use crate::asset::limits::Limits;
use crate::asset::load::load;
use crate::asset::read::read;
use crate::asset::write::{Refined, read_back, write};
use crate::asset::{Document, File, TextureSet};
use crate::atlas::{Atlas, Charts, Clusters, Topology, clusters};
use crate::context::Context;
use crate::error::{Code, Failure, Result, Warning};
use crate::metrics::report::{self, Report, Unmet};
use crate::metrics::{Measures, picture};

/// What comes in.
#[derive(Debug, Clone, Default)]
pub struct Input {
    /// Files of each model; usually one.
    pub models: Vec<Vec<File>>,
    /// What is refused as too large.
    pub limits: Limits,
    /// Whether textures and pictures are wanted as files of their own, and an archive of everything.
    pub extras: bool,
}

/// A file of the result.
#[derive(Debug, Clone)]
pub struct Artifact {
    /// File name.
    pub name: String,
    /// `model`, `side_file`, `report`, `texture`, `picture` or `archive`.
    pub role: String,
    /// Media type.
    pub media_type: String,
    /// Contents.
    pub bytes: Vec<u8>,
}

impl Artifact {
    fn new(name: impl Into<String>, role: &str, media_type: &str, bytes: Vec<u8>) -> Self {
        Artifact { name: name.into(), role: role.to_owned(), media_type: media_type.to_owned(), bytes }
    }
}

/// What comes out.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// Files.
    pub artifacts: Vec<Artifact>,
    /// The report.
    pub report: Value,
    /// Requirements that are not met.
    pub failures: Vec<Unmet>,
}
