// This file holds the two ends of light's lines past secondary edges, and evaluates the light that passes between them.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "core/sampler.h"
#include "estimator/view.h"
#include "rays/plane_hit.h"
#include "secondary/secondary_edges.h"
#include "shading/lit/indirect.h"
#include "shading/lit/lit.h"
#include "shading/lit/transfer.h"

namespace edgegrad {

// LineLight holds what lights the reflectors of lines. `casters` is the scene as light meets it.
template <class T>
struct LineLight {
    const BackwardView<T>& view;
    const SceneView<T>& casters;
    const LitPaths& lit;
    LitOptions at_reflector;  // allows the bounces that remain before the reflector

    LineLight(const BackwardView<T>& view_, const SceneView<T>& casters_, const LitPaths& lit_)
        : view(view_), casters(casters_), lit(lit_), at_reflector(lit_.options) {
        at_reflector.bounces -= 1 + lit.further;
    }
    bool is_seen() const { return lit.seen; }
};

// LineEnds holds pairs of points: a receiver and a reflector each.
class LineEnds {
   public:
    int64_t size() const { return int64_t(face_[0].size()); }
    void add(int receiver_or_reflector, int64_t face, double u, double v) {
        face_[receiver_or_reflector].push_back(face), append(b_[receiver_or_reflector], {1 - u - v, u, v});
    }

    // Returns (N, channels): the light that passes between each pair (transfer.h). Seeds count from `first` on.
    template <class T>
    std::vector<double> sent(const LineLight<T>& scene, Stream stream, int64_t first, Paths& paths) const {
        const int C = scene.lit.lit.channels;
        std::vector<double> out(size() * C);
        std::vector<int64_t> seed;
        const uint64_t numbers = seed_of(scene.view.options.seed, stream) << 32;
        for (int64_t i = 0; i < size(); ++i) seed.push_back(int64_t(numbers | uint32_t(first + i)));
        for (int64_t i = 0; i < size(); i += shaded_at_once) {
            const LitLines some{std::min(shaded_at_once, size() - i),
                                &face_[0][i],
                                &face_[1][i],
                                &b_[0][3 * i],
                                &b_[1][3 * i],
                                &seed[i]};
            send_between(scene.lit.lit, scene.casters, scene.view.geometry.caster(), some,
                         scene.is_seen() ? SentRadiance::seen_by_viewer : SentRadiance::at_receiver, paths,
                         &out[i * C]);
        }
        return out;
    }

    // Returns (N, 3) unit directions from receivers to reflectors.
    template <class T>
    std::vector<double> directions(const LineLight<T>& scene) const {
        std::vector<double> out;
        for (int64_t i = 0; i < size(); ++i) {
            const Vec3 l = unit(place(scene, 1, i) - place(scene, 0, i));
            append(out, {l.x, l.y, l.z});
        }
        return out;
    }

   private:
    template <class T>
    Vec3 place(const LineLight<T>& scene, int end, int64_t i) const {
        Vec3 out;
        for (int k = 0; k < 3; ++k) out += b_[end][3 * i + k] * corner(scene.view.scene, face_[end][i], k);
        return out;
    }

    std::vector<int64_t> face_[2];
    std::vector<double> b_[2];
};

// Evaluates the samples of records from `begin` on. Their first two surfaces are receiver and reflector; their first
// factor is the weight. Writes how much the image jumps, or the light that reaches the receiver and its direction.
template <class T>
void light_reflectors(const LineLight<T>& light, const std::vector<CurveRecords>& records, size_t begin, Stream stream,
                      SecondaryEdgeSamples& out) {
    std::vector<int64_t> first(records.size() + 1, 0);
    for (size_t k = begin; k < records.size(); ++k) first[k + 1] = first[k] + records[k].size();
    out.jump.resize(records.size()), out.origin.resize(records.size());
    constexpr int surfaces = CurveRecords::surfaces;
    const int C = light.lit.lit.channels;
    light.view.team.parallel_for_with_state(
        int64_t(records.size() - begin), [&] { return path_buffers(light.lit.lit, light.at_reflector); },
        [&](Paths& paths, int64_t block) {
            light.view.team.check();
            const size_t k = begin + size_t(block);
            const CurveRecords& record = records[k];
            LineEnds ends;
            for (int64_t i = 0; i < record.size(); ++i)
                for (int end = 0; end < 2; ++end) {
                    const int64_t at = surfaces * i + end;
                    ends.add(end, record.face[at], record.b[2 * at], record.b[2 * at + 1]);
                }
            std::vector<double>& jump = out.jump[k];
            jump = ends.sent(light, stream, first[k], paths);
            for (int64_t i = 0; i < record.size(); ++i)
                for (int c = 0; c < C; ++c) jump[i * C + c] *= record.factor[surfaces * i];
            if (!light.is_seen()) out.origin[k] = ends.directions(light);
        });
}

}  // namespace edgegrad
