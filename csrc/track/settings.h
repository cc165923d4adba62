// Holds the numbers of the tracker. Evidence: films of a textured cow, a block and a bolt of one colour (640 x 480,
// bounding boxes with a diagonal of some 230 px, lens blur of 0.7 px, noise, JPEG), as described at each number.
#pragma once

#include <cstdint>

namespace edgegrad {

struct TrackSettings {
    // Lines across the contour, and candidates from which visible ones are drawn. The errors of 100 lines are 1.3 times
    // those of 200.
    static constexpr int lines = 200, candidates = 400;
    // Points of the texture, and of the surface for depth images, that look at the camera; those that nothing hides are
    // compared.
    static constexpr int points = 400;
    // Lengths of a line's segments, px, one after the other, and the level of the image pyramid that texture is
    // compared on meanwhile. The last three use the sub-pixel edge.
    static constexpr int scales = 6, first_exact = 3;
    static constexpr int scale[scales] = {6, 4, 2, 1, 1, 1}, level[scales] = {2, 2, 1, 1, 0, 0};
    // A segment is at most this part of the object, and on a level of the pyramid the object has at least so many
    // pixels. With 14 and 25, a stone of 58 px that turns by 3 degrees a frame is lost.
    static constexpr double segments_across = 20, pixels_across = 35;
    // Gauss-Newton steps for each. Two in the last as well change no error by more than a tenth.
    static constexpr int steps[scales] = {2, 2, 2, 2, 1, 1};
    // Depth, in sizes of the object, by which a visible point may lie behind the surface: floats and coarse meshes
    // round it.
    static constexpr double surface_depth = 0.005;

    // Distances of the contour that a line compares, and how much further its pixels reach, in segments.
    static constexpr int reach = 6, side = 5;
    // Share of pixels on the right side of a contour, less one half, and half-width of its transition in segments, as
    // SRT3D has them (Stoiber et al., IJCV 2022).
    static constexpr double amplitude = 0.43, slope = 0.7;

    static constexpr int centres = 40, nearest = 3;  // local histograms on the mesh, and those that a line takes
    static constexpr double backoff = 180;           // pixels that the global histogram counts for
    static constexpr double learning_rate = 0.25;    // weight of a frame in the histograms
    static constexpr int learnt = 18;                // px on either side that colours are learnt from
    static constexpr double greatest_ratio = 3;      // bound of the log-ratio that one pixel's colour gives
    // A colour is known where a histogram holds more than this share of an even spread. An unknown object has any
    // colour.
    static constexpr double known_share = 0.25;
    static constexpr double known_pixels = 0.75;  // least share of known colours on a line: else something covers it

    // Blurs of an edge, px: of a lens, and of a line that moves by more than `moving` px a frame.
    static constexpr double blur[2] = {0.85, 2.0}, moving = 8;
    static constexpr int across = 7;  // pixels on either side of an edge that it is compared on
    static constexpr double edge_step = 0.25, edge_reach = 2.5;  // px, the grid of the edge's distances
    // Half the number of independent residuals that an edge leaves: neighbouring pixels share the lens's blur.
    static constexpr double edge_exponent = 3;
    // Residual (squared linear radiance, over seven pixels) below which an edge counts as exact.
    static constexpr double edge_noise = 1e-4;

    // Weight of a frame in the probabilities of the models of an edge's sides, and their least share. Without learning,
    // the median error of the smooth body of one colour is 0.23 instead of 0.21 degrees.
    static constexpr double model_rate = 0.25, least_model = 0.02;
    // Probability that a sharp edge is no edge of the picture. With sharp edges the block's errors are 0.10 / 0.22
    // degrees (median and 90 %), without 0.12 / 0.30.
    static constexpr double no_edge = 0.1;

    // Standard deviation of the predicted pose, radians and sizes of the object: bounds of what a film teaches, and its
    // value in the first frame, where `init` may be off by some 10 degrees.
    static constexpr double least_deviation = 0.008, greatest_deviation = 0.05, first_deviation = 0.1;
    static constexpr double deviation_rate = 0.2, velocity_rate = 0.5;
    // Deviations of the prediction within which a line expects the contour. A hand's film is 8 % off with 5, 12 % with
    // 3, and 48 % where exact edges have no gate.
    static constexpr double gate = 5;
    static constexpr double seen = 0.35;  // share of lines with an edge below which a frame teaches nothing
    // Factor of the covariance, next to the mean square of the lines' residuals (at least that of `least_residual`):
    // neighbouring lines and points share errors of the model, which the terms take for independent. With it the
    // normalised error squared over 6 is 0.5 ... 1.8 in the mean of 14 of 15 films, and 0.3 ... 2.9 without the
    // residuals.
    static constexpr double inflation = 4.7, least_residual = 0.5;

    // Depth images: bounds of the sensor's noise in sizes of the object, and the share of measurements that are of
    // something else, as fit_pose has them.
    static constexpr double depth_noise[2] = {0.002, 0.05}, occluded = 0.1;
};

}  // namespace edgegrad
