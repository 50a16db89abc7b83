//! Real models through the whole engine. They lie in `INTARSIA_DATA`, or in `../shared/data`; where they are not, these
//! tests say so and pass.

mod box_cutter;
mod compressed;
mod data;
mod defrag;
mod every;
mod expected;
mod geometry;
mod lossless;
mod node;
mod pack;
