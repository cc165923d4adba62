#include "camera/sub_cameras.h"

#include <algorithm>
#include <cmath>

namespace edgegrad {

namespace {

const Equirectangular* panorama(const Camera& camera) { return std::get_if<Equirectangular>(&camera.lens); }

// Returns the image, widened.
Box2 frame(const Camera& camera, double reach) {
    return {{-reach, -reach}, {camera.width + reach, camera.height + reach}};
}

template <CubeFaceLens L>
Camera sub_camera(const Camera& camera, const L& lens, Box2 n) {
    Camera out = camera;
    out.rotation = lens.rotation();
    for (int i = 0; i < 3; ++i) out.R.row[i] = transposed_times(camera.R, out.rotation.row[i]);
    out.t = out.rotation * camera.t;
    out.lens = lens;
    const Vec2 scale = lens.scale();
    out.set_scale(scale);
    const double y[2] = {scale.y * n.low.y, scale.y * n.high.y};
    out.lens_view = {};
    out.lens_view.end = camera.lens_view.end;
    out.lens_view.low = {scale.x * n.low.x, std::min(y[0], y[1])};
    out.lens_view.high = {scale.x * n.high.x, std::max(y[0], y[1])};
    if (!lens.cube_face().closed)
        for (int i = 1; i < 4; ++i) out.lens_view.open[i] = true;
    return out;
}

// Returns the integers k whose intervals [π (k − half), π (k + half)] meet [low, high] in more than a millionth of a
// pixel; at least one.
struct IntegerRange {
    int first, last;
};
IntegerRange covering(double low, double high, double half, double least) {
    const int first = int(std::floor((low + least) / M_PI - half)) + 1,
              last = int(std::ceil((high - least) / M_PI + half)) - 1;
    return {std::min(first, last), std::max(first, last)};
}

}  // namespace

std::vector<Camera> sub_cameras_for_rays(const Camera& camera) {
    const Box2 whole{{-1, -1}, {1, 1}};
    std::vector<Camera> out;
    if (const Equirectangular* lens = panorama(camera)) {
        for (const auto& cube_face : cube_faces)
            out.push_back(sub_camera(camera, Equirectangular(lens->K(), cube_face, {}), whole));
        return out;
    }
    if (const auto* fisheye = std::get_if<WideFisheye>(&camera.lens)) {
        for (const auto& cube_face : cube_faces)
            if (const WideFisheye lens = fisheye->through(cube_face); lens.cube_face_box(frame(camera, 1)))
                out.push_back(sub_camera(camera, lens, whole));
        // The image lies beyond the lens boundary.
        if (out.empty()) out.push_back(sub_camera(camera, *fisheye, whole));
        return out;
    }
    return {camera};
}

std::vector<Camera> sub_cameras_for_points(const Camera& camera, double reach) {
    const Box2 image = frame(camera, reach);
    std::vector<Camera> out;
    if (const auto* fisheye = std::get_if<WideFisheye>(&camera.lens)) {
        for (const auto& cube_face : cube_faces) {
            const WideFisheye lens = fisheye->through(cube_face);
            if (const auto box = lens.cube_face_box(image)) out.push_back(sub_camera(camera, lens, *box));
        }
        return out;
    }
    const Equirectangular* lens = panorama(camera);
    if (!lens) return {camera};
    constexpr double infinite = std::numeric_limits<double>::infinity();
    const Box2 angles = Equirectangular::angles(lens->K(), image);
    const double least = 1e-6 / std::fabs(lens->scale().x);
    const auto [over_first, over_last] = covering(angles.low.y, angles.high.y, 0.5, least);
    for (int over = over_first; over <= over_last; ++over) {
        // λ' = λ + j π goes around for j of the parity of `over`.
        auto [first, last] = covering(angles.low.x, angles.high.x, 1, least);
        if ((first - over) % 2) ++first;
        if ((last - over) % 2) --last;
        if (last < first) --first, last = first;
        for (int across = first; across <= last; across += 2) {
            const Equirectangular::Branch branch{
                across,
                over,
                {across == first ? -infinite : M_PI * (across - 1),
                 over == over_first ? -infinite : M_PI * (over - 0.5)},
                {across == last ? infinite : M_PI * (across + 1), over == over_last ? infinite : M_PI * (over + 0.5)}};
            for (const auto& cube_face : cube_faces) {
                const Equirectangular of_cube_face(lens->K(), cube_face, branch);
                if (const auto box = of_cube_face.cube_face_box(image))
                    out.push_back(sub_camera(camera, of_cube_face, *box));
            }
        }
    }
    return out;
}

bool is_too_wide(const Camera& camera) {
    const Equirectangular* lens = panorama(camera);
    if (!lens) return false;
    const Box2 angles = Equirectangular::angles(lens->K(), frame(camera, 1));
    const double most = std::max({-angles.low.x, -angles.low.y, angles.high.x, angles.high.y});
    return !(most <= 2 * M_PI * most_turns);
}

void add_intrinsics(const Camera& sub_camera, const IntrinsicsGrad& bar, double* K, double* distortion) {
    const bool on_cube_face = has_cube_faces(sub_camera.lens);
    const double *of_k = on_cube_face ? bar.distortion : bar.k, *of_lens = bar.distortion + (on_cube_face ? 6 : 0);
    if (K)
        for (int i = 0; i < 6; ++i) K[i] += of_k[i];
    if (distortion)
        for (int i = 0; i < (on_cube_face ? most_parameters - 6 : most_coefficients); ++i) distortion[i] += of_lens[i];
}

IntrinsicsGrad sub_camera_intrinsics(const Camera& sub_camera, const double* K, const double* distortion) {
    IntrinsicsGrad out;
    const bool on_cube_face = has_cube_faces(sub_camera.lens);
    if (K) std::copy(K, K + 6, on_cube_face ? out.distortion : out.k);
    if (distortion)
        std::copy(distortion, distortion + (on_cube_face ? most_parameters - 6 : most_coefficients),
                  out.distortion + (on_cube_face ? 6 : 0));
    return out;
}

}  // namespace edgegrad
