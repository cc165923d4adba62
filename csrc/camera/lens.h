// Defines lenses. A lens distorts normalised image coordinates n to m, and K maps m to pixels. Straight lines in n
// become curves in m, and areas grow by det ∂m/∂n. Faces, edges and the view volume are therefore handled in the
// undistorted image, K n; only samples are distorted.
#pragma once

#include <cmath>
#include <concepts>
#include <limits>
#include <memory>
#include <optional>
#include <variant>
#include <vector>

#include "camera/brown_conrady.h"
#include "camera/equirectangular.h"
#include "camera/fisheye.h"
#include "camera/wide_fisheye.h"
#include "core/math.h"

namespace edgegrad {

// Distorts nothing.
struct PinholeLens {};

template <class L>
concept Lens = requires(const L lens, Vec2 n, Vec2& n_bar, double* coefficients_bar) {
    { L::coefficients } -> std::convertible_to<int>;
    { lens.distort(n) } -> std::same_as<Vec2>;
    { lens.jacobian(n) } -> std::same_as<Mat2>;  // returns ∂m/∂n
    lens.distort_vjp(n, n, n_bar, coefficients_bar);
};

// Names a lens that sees through a face of a cube (cube_face.h). Each face is a sub-camera (sub_cameras.h).
template <class L>
concept CubeFaceLens = Lens<L> && requires(const L lens, Vec2 x, double reach, Box2 box) {
    { lens.scale() } -> std::same_as<Vec2>;
    { lens.cube_face() } -> std::same_as<const CubeFace&>;
    { lens.rotation() } -> std::same_as<Mat3>;
    { lens.has_pole() } -> std::same_as<bool>;
    { lens.undistort(x) } -> std::same_as<std::optional<Vec2>>;
    { lens.may_show(x, reach) } -> std::same_as<bool>;
    { lens.image_box(box) } -> std::same_as<Box2>;
    { lens.cube_face_box(box) } -> std::same_as<std::optional<Box2>>;
    { lens.stretch(box) } -> std::same_as<double>;
};
static_assert(CubeFaceLens<Equirectangular> && CubeFaceLens<WideFisheye>);

// Names a radial or nearly radial lens. Its functions give the radial part of |m| at |n| = r, its derivative, and the
// radii up to r where either changes its sign. is_radial() says whether no other part exists.
template <class L>
concept RadialLens = Lens<L> && requires(const L lens, double r) {
    { lens.radius(r) } -> std::same_as<double>;
    { lens.radius_slope(r) } -> std::same_as<double>;
    { lens.turning_radii(r) } -> std::same_as<std::vector<double>>;
    { lens.is_radial() } -> std::same_as<bool>;
};
static_assert(RadialLens<BrownConrady> && RadialLens<Fisheye>);

// A new lens is a file of its own, and a place in this list.
using AnyLens = std::variant<PinholeLens, BrownConrady, Fisheye, Equirectangular, WideFisheye>;
constexpr int most_coefficients = 8;  // A camera is given at most these.
static_assert(BrownConrady::coefficients <= most_coefficients && Fisheye::coefficients <= most_coefficients);
constexpr int most_parameters = 10;  // Lens parameters begin with K where a lens sees through a cube face.
static_assert(most_coefficients <= most_parameters && Equirectangular::coefficients <= most_parameters &&
              WideFisheye::coefficients <= most_parameters);

// These call f(lens) for a nearly radial lens; for one that sees through a cube face, or else return `otherwise`; and
// for any lens that distorts.
template <class F>
auto with_radial_lens(const AnyLens& lens, F f) {
    if (const auto* l = std::get_if<BrownConrady>(&lens)) return f(*l);
    return f(*std::get_if<Fisheye>(&lens));
}
template <class Result, class F>
Result with_cube_face_lens(const AnyLens& lens, Result otherwise, F f) {
    if (const auto* l = std::get_if<Equirectangular>(&lens)) return f(*l);
    if (const auto* l = std::get_if<WideFisheye>(&lens)) return f(*l);
    return otherwise;
}
template <class F>
auto with_lens(const AnyLens& lens, F f) {
    if (const auto* l = std::get_if<Equirectangular>(&lens)) return f(*l);
    if (const auto* l = std::get_if<WideFisheye>(&lens)) return f(*l);
    return with_radial_lens(lens, f);
}
inline bool has_cube_faces(const AnyLens& lens) {
    return with_cube_face_lens(lens, false, [](const auto&) { return true; });
}

class RadialInverse;

// Describes the disc in which every m of a radial lens has one n. Nothing beyond it is visible.
struct LensDisc {
    // It is the least |n| with det ∂m/∂n ≤ 0, or greatest_radius.
    double fold = std::numeric_limits<double>::infinity();
    double reach = fold;  // bounds |m| within the disc
    // It tabulates the inverse of the lens's radial part (radial_inverse.h); it may be null.
    std::shared_ptr<const RadialInverse> inverse = {};
};
LensDisc disc_of(const AnyLens& lens);
// Returns the n with |n| = fold of least det ∂m/∂n, among those that determined the fold.
Vec2 folding_place(const BrownConrady& lens, const LensDisc& disc);
constexpr double greatest_radius = 30;  // 88° from the axis; lenses that show more see through cube faces

// Returns the r in [0, fold] that the radial part of a lens maps to m, or the fold.
double undistorted_radius(const AnyLens& lens, double fold, double m);

// Returns the n in the disc that is distorted to m, if there is one.
std::optional<Vec2> undistort(const AnyLens& lens, const LensDisc& disc, Vec2 m);

// Does the same for k points near m0, in place; points without n become NaN.
void undistort_near(const AnyLens& lens, const LensDisc& disc, Vec2 m0, int k, double* x, double* y);

}  // namespace edgegrad
