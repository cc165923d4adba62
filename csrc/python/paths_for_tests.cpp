// Exposes the sampled light paths, for tests that evaluate them independently.

#include <algorithm>
#include <vector>

#include "python/arrays.h"
#include "python/lit_arrays.h"
#include "python/shaped.h"
#include "python/unlocked.h"
#include "shading/lit/path.h"

using namespace nanobind::literals;

namespace edgegrad {

namespace {

// Returns a dict of arrays (N, …): `points` of each path; (N, bounces, …) with face, b and pdf of its points; (N,
// bounces, lights, …) with index, uv, light_pdf and seen of points of lights.
template <class T>
nb::dict find_paths(const SceneArrays<T>& arrays, const LitArrays& lit, const PointArrays& from,
                    const LitOptions& options, int threads) {
    const LitPoints view = from.view(lit.scene, int64_t(arrays.faces.shape(0)));
    Paths paths(lit.scene, options);
    unlocked(threads, [&](ThreadTeam& team) {
        GeometryWork work;
        const auto geometry = arrays.geometry({}, team, work);
        paths.find(arrays.view(), geometry->caster(), view, [](int64_t) { return true; });
    });
    const size_t n = size_t(view.size), B = size_t(options.bounces), K = paths.lights().size();
    std::vector<int64_t> points(n), face(n * B), index(n * B * K);
    std::vector<double> b(3 * n * B), pdf(n * B), uv(2 * n * B * K), light_pdf(n * B * K);
    std::vector<int8_t> seen(n * B * K, not_sampled);
    for (size_t i = 0; i < n; ++i) {
        const Path path = paths.path(int64_t(i));
        points[i] = path.points;
        for (int k = 0; k < path.points; ++k) {
            const size_t at = i * B + size_t(k);
            face[at] = path.face_at(k), pdf[at] = k > 0 ? path.pdf_at(k) : 1;
            std::copy(path.b_at(k), path.b_at(k) + 3, &b[3 * at]);
            for (size_t j = 0; k > 0 && j < K; ++j) {
                const LightPoint& p = path.drawn_at(k)[j];
                index[at * K + j] = p.index, light_pdf[at * K + j] = p.pdf;
                uv[2 * (at * K + j)] = p.u, uv[2 * (at * K + j) + 1] = p.v;
                seen[at * K + j] = path.seen_at(k)[j];
            }
        }
    }
    nb::dict out;
    out["points"] = shaped(std::move(points), {n});
    out["face"] = shaped(std::move(face), {n, B}), out["b"] = shaped(std::move(b), {n, B, 3});
    out["pdf"] = shaped(std::move(pdf), {n, B});
    out["index"] = shaped(std::move(index), {n, B, K}), out["uv"] = shaped(std::move(uv), {n, B, K, 2});
    out["light_pdf"] = shaped(std::move(light_pdf), {n, B, K});
    out["seen"] = shaped(std::move(seen), {n, B, K});
    return out;
}

}  // namespace

void bind_paths_for_tests(nb::module_& m) {
    m.def("paths", &find_paths<float>, "scene"_a, "lit"_a, "points"_a, "options"_a, "threads"_a);
    m.def("paths", &find_paths<double>, "scene"_a, "lit"_a, "points"_a, "options"_a, "threads"_a);
}

}  // namespace edgegrad
