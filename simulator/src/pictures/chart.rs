//! Pages and panels: everything that makes the pictures look alike.
//!
//! Text is left to the viewer's sans-serif font, so no font is needed here. Legends stand above
//! the panels, never over data.

use std::{
    fs,
    ops::Range,
    path::{Path, PathBuf},
};

use plotters::{
    chart::ChartContext,
    coord::{Shift, types::RangedCoordf64},
    prelude::{
        Cartesian2d, ChartBuilder, Circle, DashedLineSeries, DrawingArea, IntoDrawingArea as _,
        LineSeries, PathElement, Polygon, RGBColor, SVGBackend, Text,
    },
    style::{
        Color as _, IntoFont as _, ShapeStyle, TextStyle, WHITE,
        text_anchor::{HPos, Pos, VPos},
    },
};

use super::PictureError;

/// Where a picture is drawn.
pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// A panel with two number axes.
pub(super) type Panel<'a, 'b> =
    ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

pub(super) type Points = Vec<(f64, f64)>;

// Colours that stay apart for colour-blind eyes (Okabe and Ito).
pub(super) const BLUE: RGBColor = RGBColor(0, 114, 178);
pub(super) const VERMILION: RGBColor = RGBColor(213, 94, 0);
pub(super) const GREEN: RGBColor = RGBColor(0, 158, 115);
pub(super) const PURPLE: RGBColor = RGBColor(204, 121, 167);
pub(super) const SKY: RGBColor = RGBColor(86, 180, 233);
pub(super) const INK: RGBColor = RGBColor(40, 40, 40);
pub(super) const GREY: RGBColor = RGBColor(150, 150, 150);
const GRID: RGBColor = RGBColor(225, 225, 225);

/// Height of title and legend.
const HEADER: i32 = 64;

/// Room for an axis' numbers and name: left and below.
const LEFT: i32 = 66;
const BELOW: i32 = 46;
const MARGIN: i32 = 12;

/// How a legend shows its entry.
#[derive(Debug, Clone, Copy)]
pub(super) enum Mark {
    Line,
    Dashed,
    Dot,
    Patch,
}

/// One entry of a legend.
pub(super) type Entry = (&'static str, Mark, RGBColor);

/// Names and ranges of a panel's axes.
#[derive(Debug, Clone)]
pub(super) struct Axes {
    pub x: Range<f64>,
    pub y: Range<f64>,
    pub x_name: &'static str,
    pub y_name: &'static str,
    pub title: String,
}

/// Draws one page into `path`.
pub(super) fn page(
    path: &Path,
    size: (u32, u32),
    title: &str,
    legend: &[(impl AsRef<str>, Mark, RGBColor)],
    draw: impl FnOnce(&Area<'_>) -> Result<(), PictureError>,
) -> Result<PathBuf, PictureError> {
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
        root.fill(&WHITE)?;
        let (header, body) = root.split_vertically(HEADER);
        header.draw(&Text::new(title.to_owned(), (MARGIN, 10), font(21.0)))?;
        draw_legend(&header, legend)?;
        draw(&body)?;
        root.present()?;
    }
    fs::write(path, text)?;
    Ok(path.to_path_buf())
}

fn draw_legend(
    header: &Area<'_>,
    legend: &[(impl AsRef<str>, Mark, RGBColor)],
) -> Result<(), PictureError> {
    let mut x = MARGIN;
    let y = 46;
    for (name, mark, color) in legend {
        let thick = ShapeStyle::from(color).stroke_width(2);
        match mark {
            Mark::Line => header.draw(&PathElement::new(vec![(x, y), (x + 24, y)], thick))?,
            Mark::Dashed => {
                for start in [x, x + 9, x + 18] {
                    let dash = vec![(start, y), (start + 6, y)];
                    header.draw(&PathElement::new(dash, thick))?;
                }
            }
            Mark::Dot => header.draw(&Circle::new((x + 12, y), 4, color.filled()))?,
            Mark::Patch => {
                let corners = vec![(x, y - 6), (x + 24, y - 6), (x + 24, y + 6), (x, y + 6)];
                header.draw(&Polygon::new(corners, color.mix(0.35).filled()))?;
            }
        }
        let name = name.as_ref();
        header.draw(&Text::new(name.to_owned(), (x + 30, y - 8), font(18.0)))?;
        // No font is measured here: 8 px a character is wide enough for 14.5 px sans-serif.
        x += 30 + 8 * i32::try_from(name.chars().count()).unwrap_or(0) + 22;
    }
    Ok(())
}

/// Opens a panel with grid, numbers and names.
pub(super) fn panel<'a, 'b>(
    area: &'a Area<'b>,
    axes: &Axes,
) -> Result<Panel<'a, 'b>, PictureError> {
    let mut builder = ChartBuilder::on(area);
    builder
        .margin(MARGIN)
        .margin_right(2 * MARGIN)
        .x_label_area_size(BELOW)
        .y_label_area_size(LEFT);
    if !axes.title.is_empty() {
        builder.caption(axes.title.clone(), font(18.0));
    }
    let mut chart = builder.build_cartesian_2d(axes.x.clone(), axes.y.clone())?;
    let pixels = chart.plotting_area().dim_in_pixel();
    chart
        .configure_mesh()
        .light_line_style(WHITE.mix(0.0))
        .bold_line_style(GRID)
        .axis_style(INK)
        .x_labels((pixels.0 / 70).max(2) as usize)
        .y_labels((pixels.1 / 45).max(2) as usize)
        .x_desc(axes.x_name)
        .y_desc(axes.y_name)
        .label_style(font(16.0))
        .axis_desc_style(font(18.0))
        .x_label_formatter(&|value| plain(*value))
        .y_label_formatter(&|value| plain(*value))
        .draw()?;
    Ok(chart)
}

/// Opens a panel whose horizontal axis only separates things.
pub(super) fn unnumbered_panel<'a, 'b>(
    area: &'a Area<'b>,
    axes: &Axes,
) -> Result<Panel<'a, 'b>, PictureError> {
    let mut chart = ChartBuilder::on(area)
        .margin(MARGIN)
        .x_label_area_size(8)
        .y_label_area_size(LEFT - 20)
        .caption(axes.title.clone(), font(18.0))
        .build_cartesian_2d(axes.x.clone(), axes.y.clone())?;
    chart
        .configure_mesh()
        .disable_x_mesh()
        .light_line_style(WHITE.mix(0.0))
        .bold_line_style(GRID)
        .axis_style(INK)
        .x_labels(0)
        .label_style(font(16.0))
        .y_label_formatter(&|value| plain(*value))
        .draw()?;
    Ok(chart)
}

/// Widens one of two ranges so that a unit is as long on both axes of a panel in `area`.
pub(super) fn equal(area: &Area<'_>, x: Range<f64>, y: Range<f64>) -> (Range<f64>, Range<f64>) {
    let (width, height) = area.dim_in_pixel();
    let inner = |outer: u32, used: i32| f64::from(outer) - f64::from(used + 2 * MARGIN);
    let (width, height) = (inner(width, LEFT + MARGIN), inner(height, BELOW));
    let scale = ((x.end - x.start) / width).max((y.end - y.start) / height);
    let around = |range: Range<f64>, pixels: f64| {
        let (middle, half) = (0.5 * (range.start + range.end), 0.5 * scale * pixels);
        middle - half..middle + half
    };
    (around(x, width), around(y, height))
}

/// The range of some numbers, a little wider; never empty.
pub(super) fn range(values: impl IntoIterator<Item = f64>) -> Range<f64> {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for value in values.into_iter().filter(|value| value.is_finite()) {
        (low, high) = (low.min(value), high.max(value));
    }
    if low > high {
        return 0.0..1.0;
    }
    let pad = 0.05 * (high - low).max(1e-9 + 1e-3 * high.abs().max(low.abs()));
    low - pad..high + pad
}

/// The same, from zero up: for quantities that are never negative.
pub(super) fn from_zero(values: impl IntoIterator<Item = f64>) -> Range<f64> {
    let largest = values.into_iter().filter(|value| value.is_finite()).fold(0.0, f64::max);
    0.0..if largest > 0.0 { 1.1 * largest } else { 1.0 }
}

/// "1 run", "2 runs".
pub(super) fn counted(runs: usize) -> String {
    if runs == 1 { "1 run".into() } else { format!("{runs} runs") }
}

/// A line through points.
pub(super) fn line(
    chart: &mut Panel<'_, '_>,
    points: Points,
    color: RGBColor,
    opacity: f64,
    width: u32,
) -> Result<(), PictureError> {
    let style = ShapeStyle::from(color.mix(opacity)).stroke_width(width);
    for piece in Window::of(chart).pieces(&points) {
        chart.draw_series(LineSeries::new(piece, style))?;
    }
    Ok(())
}

/// A dashed line through points.
pub(super) fn dashed(
    chart: &mut Panel<'_, '_>,
    points: Points,
    color: RGBColor,
) -> Result<(), PictureError> {
    let style = ShapeStyle::from(color).stroke_width(2);
    for piece in Window::of(chart).pieces(&points) {
        chart.draw_series(DashedLineSeries::new(piece, 6, 5, style))?;
    }
    Ok(())
}

/// Filled circles.
pub(super) fn dots(
    chart: &mut Panel<'_, '_>,
    points: Points,
    color: RGBColor,
    radius: i32,
) -> Result<(), PictureError> {
    let window = Window::of(chart);
    let inside = points.into_iter().filter(|point| window.contains(*point));
    chart.draw_series(inside.map(|point| Circle::new(point, radius, color.filled())))?;
    Ok(())
}

/// A filled shape with an outline.
pub(super) fn shape(
    chart: &mut Panel<'_, '_>,
    corners: Points,
    color: RGBColor,
    opacity: f64,
) -> Result<(), PictureError> {
    let mut corners = Window::of(chart).polygon(corners);
    let Some(first) = corners.first().copied() else { return Ok(()) };
    let fill = Polygon::new(corners.clone(), color.mix(opacity).filled());
    corners.push(first);
    let edge = PathElement::new(corners, ShapeStyle::from(color.mix(0.7)).stroke_width(1));
    chart.draw_series([fill])?;
    chart.draw_series([edge])?;
    Ok(())
}

/// Text centred above a place in a panel.
pub(super) fn note(
    chart: &mut Panel<'_, '_>,
    place: (f64, f64),
    text: String,
) -> Result<(), PictureError> {
    let style = font(16.0).pos(Pos::new(HPos::Center, VPos::Bottom));
    chart.draw_series([Text::new(text, place, style)])?;
    Ok(())
}

/// The visible part of a panel: the drawing library would pile up on the border what lies beyond.
struct Window {
    x: Range<f64>,
    y: Range<f64>,
}

impl Window {
    fn of(chart: &Panel<'_, '_>) -> Self {
        Self { x: chart.x_range(), y: chart.y_range() }
    }

    fn contains(&self, (x, y): (f64, f64)) -> bool {
        (self.x.start..=self.x.end).contains(&x) && (self.y.start..=self.y.end).contains(&y)
    }

    /// How far inside each border a point is.
    fn depths(&self, (x, y): (f64, f64)) -> [f64; 4] {
        [x - self.x.start, self.x.end - x, y - self.y.start, self.y.end - y]
    }

    /// The visible pieces of a line (Liang and Barsky, segment by segment).
    fn pieces(&self, points: &[(f64, f64)]) -> Vec<Points> {
        let mut pieces: Vec<Points> = Vec::new();
        let mut open = false;
        for pair in points.windows(2) {
            let (from, to) = (self.depths(pair[0]), self.depths(pair[1]));
            let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
            for (a, b) in from.into_iter().zip(to) {
                match (a < 0.0, b < 0.0) {
                    (true, true) => enter = f64::INFINITY,
                    (true, false) => enter = enter.max(a / (a - b)),
                    (false, true) => leave = leave.min(a / (a - b)),
                    (false, false) => {}
                }
            }
            if enter > leave {
                open = false;
                continue;
            }
            if !open || enter > 0.0 {
                pieces.push(vec![between(pair[0], pair[1], enter)]);
            }
            if let Some(piece) = pieces.last_mut() {
                piece.push(between(pair[0], pair[1], leave));
            }
            open = leave >= 1.0;
        }
        pieces
    }

    /// The visible part of a convex polygon (Sutherland and Hodgman, border by border).
    fn polygon(&self, mut corners: Points) -> Points {
        for border in 0..4 {
            let mut kept = Points::new();
            for (index, &corner) in corners.iter().enumerate() {
                let next = corners[(index + 1) % corners.len()];
                let (a, b) = (self.depths(corner)[border], self.depths(next)[border]);
                if a >= 0.0 {
                    kept.push(corner);
                }
                if (a < 0.0) != (b < 0.0) {
                    kept.push(between(corner, next, a / (a - b)));
                }
            }
            corners = kept;
        }
        corners
    }
}

fn between(from: (f64, f64), to: (f64, f64), share: f64) -> (f64, f64) {
    (from.0 + share * (to.0 - from.0), from.1 + share * (to.1 - from.1))
}

fn font(size: f64) -> TextStyle<'static> {
    // The backend divides sizes by 1.24: 18 here are 14.5 px in the file.
    ("sans-serif", size).into_font().color(&INK)
}

/// Numbers of an axis without needless zeros.
fn plain(value: f64) -> String {
    let text = format!("{value:.6}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".into() } else { text.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW: Window = Window { x: 0.0..10.0, y: 0.0..10.0 };

    #[test]
    fn window_cuts_a_line_into_its_visible_pieces() {
        let line = [(-5.0, 5.0), (5.0, 5.0), (5.0, 15.0), (6.0, 15.0), (6.0, 5.0)];
        let expected = [vec![(0.0, 5.0), (5.0, 5.0), (5.0, 10.0)], vec![(6.0, 10.0), (6.0, 5.0)]];
        assert_eq!(WINDOW.pieces(&line), expected);
        assert!(WINDOW.pieces(&[(-1.0, 0.0), (-1.0, 9.0)]).is_empty());
    }

    #[test]
    fn window_cuts_a_polygon_at_its_borders() {
        let square = vec![(5.0, 5.0), (15.0, 5.0), (15.0, 15.0), (5.0, 15.0)];
        let expected = [(5.0, 10.0), (5.0, 5.0), (10.0, 5.0), (10.0, 10.0)];
        let cut = WINDOW.polygon(square);
        assert_eq!(cut.len(), 4);
        assert!(expected.iter().all(|corner| cut.contains(corner)), "{cut:?}");
    }
}
