// Which faces the samples of the image hit, and what that says of their neighbours.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <vector>

#include "camera/vertices.h"
#include "core/array.h"
#include "core/parallel.h"
#include "estimator/occlusion.h"
#include "scene/scene.h"
#include "scene/topology.h"

namespace edgegrad {

// By vertex: a face smaller than the distance of the samples is hit by chance, so it is asked together with its
// neighbours. By part of the surface (faces connected by shared vertices) and side: a closed mesh shows one side alone.
class ImageHits {
   public:
    // `seen` (F,): see HitBuffers.
    template <class T>
    ImageHits(const SceneView<T>& scene, const Camera& camera, const VertexView& vertices,
              const OcclusionHint& occlusion, const Parts& parts, const uint8_t* seen, ThreadTeam& team)
        : parts_(parts), at_(scene.n_verts), share_(2 * parts.size()) {
        team.parallel_for_blocks(scene.n_verts, [&](int64_t, int64_t first, int64_t last) {
            for (int64_t v = first; v < last; ++v)
                at_[v] = camera.is_undistorted() && !vertices.outcode[v] &&
                                 occlusion.hides_around(vertices.x[v], vertices.q[v].z)
                             ? behind
                             : 0;
        });
        std::vector<int32_t> hits(2 * parts_.size(), 0);  // faces that were hit, by part and side
        const auto mark = [&](const int32_t* v, uint8_t bit) {
            for (int i = 0; i < 3; ++i) {
                const std::atomic_ref at(at_[v[i]]);
                if (!(at.load(std::memory_order_relaxed) & bit)) at.fetch_or(bit, std::memory_order_relaxed);
            }
        };
        team.parallel_for_blocks(scene.n_faces, [&](int64_t, int64_t first, int64_t last) {
            // Neighbours mostly count for the same, and threads that all add to one number wait for each other.
            int64_t counter = 0;
            int32_t n = 0;
            const auto count = [&] {
                if (n) std::atomic_ref(hits[counter]).fetch_add(n, std::memory_order_relaxed);
            };
            for (int64_t f = first; f < last; ++f) {
                if (!seen[f]) continue;
                const int32_t* v = scene.faces + 3 * f;
                mark(v, hit);
                const int64_t own = 2 * int64_t(parts_.of(v[0])) + (seen[f] == 2);
                if (own != counter) count(), counter = own, n = 0;
                ++n;
            }
            count();
        });
        team.parallel_for_blocks(scene.n_faces, [&](int64_t k, int64_t first, int64_t last) {
            // Where no face of a part was hit there is no border.
            if (const int64_t part = parts_.of_block(k); part >= 0 && hits[2 * part] + hits[2 * part + 1] == 0) return;
            for (int64_t f = first; f < last; ++f) {
                const int32_t* v = scene.faces + 3 * f;
                const auto is_hit = [&](int i) {
                    return std::atomic_ref(at_[v[i]]).load(std::memory_order_relaxed) & hit;
                };
                const int n = is_hit(0) + is_hit(1) + is_hit(2);
                if (n == 1 || n == 2) mark(v, border);
            }
        });
        team.parallel_for_blocks(parts_.size(), [&](int64_t, int64_t first, int64_t last) {
            for (int64_t k = 2 * first; k < 2 * last; ++k) {
                const double all = double(hits[k]) + hits[k ^ 1];
                share_[k] = all < enough ? 1 : float(hits[k] / all);
            }
        });
    }

    // Whether a face with this vertex was hit.
    bool at(int64_t vertex) const { return at_[vertex] & hit; }

    // What the corners of a face say together: `missed`: none is of a face that was hit; `partly`: one is, or of a
    // neighbour of such a face; `whole`: all are of faces that were hit; `clear`: and no face next to it has others.
    struct Face {
        bool missed, partly, whole, clear;
    };
    Face of(const int32_t* v) const {
        const uint8_t a = at_[v[0]], b = at_[v[1]], c = at_[v[2]];
        return {((a | b | c) & hit) == 0, ((a | b | c) & (hit | border)) != 0, (a & b & c & hit) != 0,
                !((a | b | c) & border)};
    }

    // Whether the corners of a face lie inside the view, behind all that was hit around them (OcclusionHint), and it is
    // no neighbour of a face that was hit.
    bool are_behind(const int32_t* v) const {
        return at_[v[0]] == behind && at_[v[1]] == behind && at_[v[2]] == behind;
    }

    // What the density of samples is multiplied by on a face with this vertex that was not hit, nor a neighbour: by
    // less if the image hit the part of the surface to which it belongs from the other side alone, as a closed mesh.
    // `side`, 1 or 2, is that from which the face would be visible. Never zero, for it may be visible all the same. A
    // side counts in full from a share of `some` of the hits on its part.
    static constexpr double missed = 1.0 / 8;
    double where_missed(int32_t vertex, int side) const {
        const int64_t part = parts_.size() > 1 ? parts_.of(vertex) : 0;
        return std::clamp(share_[2 * part + side - 1] / some * missed, turned_away, missed);
    }

    // Whether that is as little as it ever is.
    bool is_turned_away(int32_t vertex, int side) const { return where_missed(vertex, side) <= turned_away; }
    static constexpr double turned_away = 1.0 / 64;

    // With those of Parts, of which there may be as many as vertices.
    static constexpr int64_t bytes_per_vertex = sizeof(uint8_t) + 4 * sizeof(float);

    void prefetch(int32_t vertex) const { edgegrad::prefetch(&at_[vertex]); }

   private:
    // Of a vertex: of a face that was hit; of a face that has such vertices and others; behind all around it.
    static constexpr uint8_t hit = 1, border = 2, behind = 4;
    static constexpr double some = 1.0 / 16;
    static constexpr int enough = 64;  // faces that say which sides of a part are visible
    const Parts& parts_;
    Array<uint8_t> at_;
    std::vector<float> share_;  // by part and side: of the faces of the part that were hit; 1 where too few were
};

}  // namespace edgegrad
