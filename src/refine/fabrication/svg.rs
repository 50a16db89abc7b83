//! Panels as SVG, one user unit a millimetre.

use std::fmt::Write as _;

use glam::DVec2;

use super::outline::normal;
use crate::atlas::ChartId;

/// Height of the numbers, in millimetres: at most, and of the length of their seam.
const TALLEST: f64 = 4.0;
const TALLEST_OF_SEAM: f64 = 0.5;

/// The look of everything; cutters go by the classes or the colours.
const STYLE: &str = "path{fill:none;stroke-width:.2}.outline{stroke:#000}.allowance{stroke:#c00}.flap{stroke:#06c}\
                     .fold{stroke:#080;stroke-dasharray:2 1}.number{fill:#000;font-family:sans-serif;text-anchor:middle;\
                     dominant-baseline:central}";

/// A sheet that is being drawn.
pub(super) struct Sheet {
    text: String,
}

impl Sheet {
    /// A sheet of this size in millimetres, with room for what is drawn beyond outlines at its edge.
    pub fn new([width, height]: [f64; 2], margin: f64) -> Self {
        let (w, h) = (number(width + 2.0 * margin), number(height + 2.0 * margin));
        let m = number(-margin);
        let text = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w}mm\" height=\"{h}mm\" viewBox=\"{m} {m} {w} {h}\">\n\
             <style>{STYLE}</style>\n"
        );
        Sheet { text }
    }

    /// Begins a panel; `area` in square millimetres is above zero where the upload mirrors it.
    pub fn open(&mut self, chart: ChartId, area: f64) {
        let side = if area > 0.0 { "inside" } else { "outside" };
        self.add(&format!(
            "<g id=\"panel-{}\" data-side=\"{side}\" data-area-mm2=\"{}\">",
            chart.index(),
            number(area.abs())
        ));
    }

    /// Ends a panel.
    pub fn close(&mut self) {
        self.add("</g>");
    }

    /// Closed lines of a class: `outline` is that of a panel and of its holes, `allowance` the one that is cut where panels are sewn.
    pub fn closed(&mut self, class: &str, rings: &[Vec<DVec2>]) {
        let rings: Vec<String> = rings.iter().filter(|r| r.len() > 2).map(|r| line(r) + "Z").collect();
        if !rings.is_empty() {
            let text = format!("<path class=\"{class}\" d=\"{}\"/>", rings.concat());
            self.add(&text);
        }
    }

    /// A line to fold along.
    pub fn fold(&mut self, [a, b]: [DVec2; 2]) {
        self.add(&format!("<path class=\"fold\" d=\"M{}L{}\"/>", point(a), point(b)));
    }

    /// The flap of a seam.
    pub fn flap(&mut self, seam: usize, points: &[DVec2]) {
        if points.len() > 2 {
            let text = format!("<path class=\"flap\" data-seam=\"{seam}\" d=\"{}\"/>", line(points));
            self.add(&text);
        }
    }

    /// The number of a seam, inside the panel at the middle of the seam's line.
    pub fn number(&mut self, seam: usize, points: &[DVec2], outward: f64) {
        let length: f64 = points.windows(2).map(|w| (w[1] - w[0]).length()).sum();
        let size = (TALLEST_OF_SEAM * length).min(TALLEST);
        let mut left = 0.5 * length;
        for w in points.windows(2) {
            let own = (w[1] - w[0]).length();
            if left <= own {
                let t = if own > 0.0 { left / own } else { 0.0 };
                let at = w[0].lerp(w[1], t) - normal([w[0], w[1]], outward) * size * 0.7;
                let text = format!(
                    "<text class=\"number\" data-seam=\"{seam}\" x=\"{}\" y=\"{}\" font-size=\"{}\">{seam}</text>",
                    number(at.x),
                    number(at.y),
                    number(size)
                );
                self.add(&text);
                return;
            }
            left -= own;
        }
    }

    /// The whole document.
    pub fn finish(mut self) -> String {
        self.add("</svg>");
        self.text
    }

    fn add(&mut self, text: &str) {
        self.text.push_str(text);
        self.text.push('\n');
    }
}

fn line(points: &[DVec2]) -> String {
    let mut text = String::new();
    for (i, p) in points.iter().enumerate() {
        // Writing to a string does not fail.
        let _ = write!(text, "{}{}", if i == 0 { 'M' } else { 'L' }, point(*p));
    }
    text
}

fn point(p: DVec2) -> String {
    format!("{} {}", number(p.x), number(p.y))
}

/// Micrometres, without zeros that say nothing.
fn number(value: f64) -> String {
    let text = format!("{value:.3}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}
