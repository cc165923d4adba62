// Receives lit scenes from Python (edgegrad/light/layout.py): tables, and meshes and lights that refer to them by
// number. It keeps them alive, and checks them.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "python/arrays.h"
#include "python/checks.h"
#include "shading/lit/emissive_face_tree.h"
#include "shading/lit/lit_scene.h"

namespace edgegrad {

using AnyTable = nb::ndarray<nb::numpy, nb::ro, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Rows = In<int32_t, 2>;

struct SourceArrays {
    Source view;
    std::optional<Rows> uv_faces;
};

struct MeshArrays {
    LitMesh view;
    std::vector<SourceArrays> kept;
    std::optional<Rows> normal_faces;
};

struct LightArrays {
    Light view;
    std::vector<std::optional<In<double, 1>>> arrays;  // `view` refers to these.
    std::shared_ptr<EmissiveFaceTree> tree;
};

// Holds all of it, and checks that every index exists.
class LitArrays {
   public:
    LitArrays(std::vector<AnyTable> tables, std::vector<MeshArrays> meshes, std::vector<LightArrays> lights, Rows faces,
              int verts, int eye, bool perspective, int channels, const std::vector<double>& ball);

    LitScene scene;

   private:
    const Table& table(int number) const { return scene.tables[size_t(number)]; }
    void check_table(const char* name, int number, int64_t rows, int columns) const;
    void check_channels(const char* name, int number, int64_t rows, int channels) const;
    void check_index(const char* name, const int32_t* index, int64_t faces, int number) const;
    void check_source(const char* name, const SourceArrays& arrays, const LitMesh& mesh, int channels) const;
    void check_mesh(const MeshArrays& arrays) const;
    void check_light(const Light& light) const;

    std::vector<AnyTable> tables_;
    std::vector<MeshArrays> meshes_;
    std::vector<LightArrays> lights_;
    Rows faces_;
};

// Rejects lit scenes of other faces than the scene's.
template <class T>
void check_faces(const SceneArrays<T>& arrays, const LitArrays& lit) {
    if (arrays.faces.shape(0) == 0 ||
        size_t(lit.scene.meshes.back().first_face + lit.scene.meshes.back().faces) != arrays.faces.shape(0))
        refuse("lit: expected the faces of the scene");
}

// Holds points, and what is fixed for one light at them.
struct PointArrays {
    In<int64_t, 1> face;
    In<double, 2> b;
    In<int64_t, 1> seed;
    int forced_light;
    std::optional<In<int64_t, 1>> index;
    std::optional<In<double, 2>> uv;
    std::optional<In<double, 1>> pdf;
    std::optional<In<uint8_t, 1>> lit;
    std::optional<In<double, 3>> spread;

    LitPoints view(const LitScene& scene, int64_t faces) const;
};

}  // namespace edgegrad
