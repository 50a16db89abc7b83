//! Real models through the whole engine. They lie in `INTARSIA_DATA`, or in `../shared/data`; where there is no such folder,
//! these tests say so and pass. Where there is one, a test that finds nothing to try in it fails.

mod bounded;
mod box_cutter;
mod compressed;
mod data;
mod defrag;
mod every;
mod expected;
mod geometry;
mod lossless;
mod node;
mod optcuts;
mod pack;
