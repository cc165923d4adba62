// This file stores which faces the samples of the image hit, and what that implies for their neighbours.
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

// ImageHits stores hits by vertex, because a face smaller than the sample spacing is hit by chance. Its neighbours are
// therefore tested with it. It also stores hits by side and part of the surface (faces connected by shared vertices),
// because a closed mesh shows one side only.
class ImageHits {
   public:
    // For `seen` (F,) see HitBuffers.
    template <class T>
    ImageHits(const SceneView<T>& scene, const Camera& camera, const VertexView& vertices,
              const OcclusionHint& occlusion, const ConnectedParts& parts, const uint8_t* seen, ThreadTeam& team)
        : parts_(parts), at_(scene.n_verts), share_(2 * parts.size()) {
        team.parallel_for_blocks(scene.n_verts, [&](int64_t, int64_t first, int64_t last) {
            for (int64_t v = first; v < last; ++v)
                at_[v] = camera.is_undistorted() && !vertices.outcode[v] &&
                                 occlusion.hides_around(vertices.x[v], vertices.q[v].z)
                             ? behind
                             : 0;
        });
        std::vector<int32_t> hits(2 * parts_.size(), 0);  // number of hit faces, by part and side
        const auto mark = [&](const int32_t* v, uint8_t bit) {
            for (int i = 0; i < 3; ++i) {
                const std::atomic_ref at(at_[v[i]]);
                if (!(at.load(std::memory_order_relaxed) & bit)) at.fetch_or(bit, std::memory_order_relaxed);
            }
        };
        team.parallel_for_blocks(scene.n_faces, [&](int64_t, int64_t first, int64_t last) {
            // Neighbours mostly add to the same counter. Sums are local, as threads on one counter wait for each other.
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
            // A part without hits has no border.
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

    // Returns whether a face with this vertex was hit.
    bool at(int64_t vertex) const { return at_[vertex] & hit; }

    // FaceHits combines the corners of a face. `missed`: none belongs to a hit face. `partly`: one belongs to a hit
    // face or to its neighbour. `whole`: all belong to hit faces. `clear`: no adjacent face has other corners.
    struct FaceHits {
        bool missed, partly, whole, clear;
    };
    FaceHits of(const int32_t* v) const {
        const uint8_t a = at_[v[0]], b = at_[v[1]], c = at_[v[2]];
        return {((a | b | c) & hit) == 0, ((a | b | c) & (hit | border)) != 0, (a & b & c & hit) != 0,
                !((a | b | c) & border)};
    }

    // Returns whether a face's corners lie inside the view and behind all hits around them (OcclusionHint). The face
    // must not neighbour a hit face.
    bool are_behind(const int32_t* v) const {
        return at_[v[0]] == behind && at_[v[1]] == behind && at_[v[2]] == behind;
    }

    // where_missed() returns the factor on the sample density of a face with this vertex that was not hit, nor a
    // neighbour. It is smaller if all hits on its part were from the other side, as on a closed mesh. `side`, 1 or 2,
    // is that from which the face would be visible. It is never zero, because the face may still be visible. A side
    // with the fraction `enough_of_part` of the part's hits counts in full.
    static constexpr double missed = 1.0 / 8;
    double where_missed(int32_t vertex, int side) const {
        const int64_t part = parts_.size() > 1 ? parts_.of(vertex) : 0;
        return std::clamp(share_[2 * part + side - 1] / enough_of_part * missed, turned_away, missed);
    }

    // Returns whether that factor is minimal.
    bool is_turned_away(int32_t vertex, int side) const { return where_missed(vertex, side) <= turned_away; }
    static constexpr double turned_away = 1.0 / 64;

    // This includes ConnectedParts, which may be as many as vertices.
    static constexpr int64_t bytes_per_vertex = sizeof(uint8_t) + 4 * sizeof(float);

    void prefetch(int32_t vertex) const { edgegrad::prefetch(&at_[vertex]); }

   private:
    // A `hit` vertex belongs to a hit face. A `border` vertex belongs to a face with such vertices and others. A
    // `behind` vertex lies behind all hits around it.
    static constexpr uint8_t hit = 1, border = 2, behind = 4;
    static constexpr double enough_of_part = 1.0 / 16;
    static constexpr int enough = 64;  // number of hit faces that tells which sides of a part are visible
    const ConnectedParts& parts_;
    Array<uint8_t> at_;
    std::vector<float> share_;  // fraction of a part's hits, by part and side; 1 where too few were hit
};

}  // namespace edgegrad
