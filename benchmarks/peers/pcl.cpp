// PCL's correspondence grouping behind four C functions, for benchmarks/peers/pcl.py.
//
// Built by `make bench-peers` into _pcl.so beside this file. PCL_NO_PRECOMPILE has the templates compiled here, with
// our flags (-O3 -march=native), instead of taken from the package's library, which is built for any x86-64.
// -march=native alone would make Eigen align to 32 bytes where the library aligns to 16: EIGEN_MAX_ALIGN_BYTES=16 keeps
// both the same.
//
// Matrices are row-major, poses target_from_source. Nothing here may throw across the boundary.

#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <unordered_map>
#include <vector>

#include <Eigen/Geometry>
#include <pcl/console/print.h>
#include <pcl/correspondence.h>
#include <pcl/features/board.h>
#include <pcl/features/normal_3d.h>
#include <pcl/pcl_config.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/recognition/cg/geometric_consistency.h>
#include <pcl/recognition/cg/hough_3d.h>

namespace {

using Point = pcl::PointXYZ;
using Cloud = pcl::PointCloud<Point>;
using Normals = pcl::PointCloud<pcl::Normal>;
using Frames = pcl::PointCloud<pcl::ReferenceFrame>;
using Poses = std::vector<Eigen::Matrix4f, Eigen::aligned_allocator<Eigen::Matrix4f>>;

Cloud::Ptr cloud_of(const float* xyz, int n) {
    Cloud::Ptr cloud(new Cloud);
    cloud->resize(n);
    for (int i = 0; i < n; ++i) (*cloud)[i] = Point(xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]);
    return cloud;
}

// Those given, or PCL's own.
Normals::Ptr normals_of(const Cloud::Ptr& cloud, const float* given, int neighbors) {
    Normals::Ptr normals(new Normals);
    if (given != nullptr) {
        normals->resize(cloud->size());
        for (std::size_t i = 0; i < cloud->size(); ++i)
            (*normals)[i] = pcl::Normal(given[3 * i], given[3 * i + 1], given[3 * i + 2]);
        return normals;
    }
    pcl::NormalEstimation<Point, pcl::Normal> estimation;
    estimation.setInputCloud(cloud);
    estimation.setKSearch(neighbors);
    estimation.compute(*normals);
    return normals;
}

Frames::Ptr frames_of(const Cloud::Ptr& points, const Cloud::Ptr& surface, const Normals::Ptr& normals, float radius) {
    Frames::Ptr frames(new Frames);
    pcl::BOARDLocalReferenceFrameEstimation<Point, pcl::Normal, pcl::ReferenceFrame> estimation;
    estimation.setFindHoles(true);
    estimation.setRadiusSearch(radius);
    estimation.setInputCloud(points);
    estimation.setInputNormals(normals);
    estimation.setSearchSurface(surface);
    estimation.compute(*frames);
    return frames;
}

// Writes at most `capacity` poses and the number of correspondences of each; returns how many there are.
// `refit`: least squares over a group's correspondences in place of PCL's pose, which fits the best three of them.
int write(const Poses& poses, const std::vector<pcl::Correspondences>& groups, const Cloud& model, const Cloud& scene,
          bool refit, int capacity, double* out, int* counts) {
    int written = 0;
    for (std::size_t g = 0; g < poses.size() && written < capacity; ++g) {
        Eigen::Matrix4d pose = poses[g].cast<double>();
        const auto& group = groups[g];
        if (refit && group.size() >= 3) {
            Eigen::Matrix3Xd from(3, group.size()), to(3, group.size());
            for (std::size_t i = 0; i < group.size(); ++i) {
                from.col(i) = model[group[i].index_query].getVector3fMap().cast<double>();
                to.col(i) = scene[group[i].index_match].getVector3fMap().cast<double>();
            }
            pose = Eigen::umeyama(from, to, false);
        }
        if (!pose.allFinite()) continue;
        Eigen::Map<Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(out + 16 * written) = pose;
        counts[written++] = static_cast<int>(group.size());
    }
    return written;
}

struct HoughModel {
    Cloud::Ptr cloud;
    Frames::Ptr frames;
    float radius;
    int neighbors;
};

}  // namespace

extern "C" {

const char* peers_pcl_version() { return PCL_VERSION_PRETTY; }

// corr: (m, 2) rows of the model and of the scene; distance: (m,) of the descriptors, which the grouping begins with
// the least of. Returns the number of poses, -1 on an error inside PCL.
int peers_pcl_gc(const float* model_xyz, int n, const float* scene_xyz, int q, const std::int32_t* corr,
                 const float* distance, int m, double size, int threshold, int refit, int capacity, double* out,
                 int* counts) try {
    pcl::console::setVerbosityLevel(pcl::console::L_ALWAYS);
    const auto model = cloud_of(model_xyz, n);
    const auto scene = cloud_of(scene_xyz, q);
    pcl::CorrespondencesPtr pairs(new pcl::Correspondences);
    pairs->reserve(m);
    for (int i = 0; i < m; ++i) pairs->emplace_back(corr[2 * i], corr[2 * i + 1], distance[i]);

    pcl::GeometricConsistencyGrouping<Point, Point> grouping;
    grouping.setGCSize(size);
    grouping.setGCThreshold(threshold);
    grouping.setInputCloud(model);
    grouping.setSceneCloud(scene);
    grouping.setModelSceneCorrespondences(pairs);
    Poses poses;
    std::vector<pcl::Correspondences> groups;
    grouping.recognize(poses, groups);
    return write(poses, groups, *model, *scene, refit, capacity, out, counts);
} catch (...) {
    return -1;
}

// What a user prepares once for a model: its local reference frames. Null on an error inside PCL.
void* peers_pcl_hough_model(const float* xyz, const float* normals, int n, double frame_radius, int neighbors) try {
    pcl::console::setVerbosityLevel(pcl::console::L_ALWAYS);
    auto model = std::make_unique<HoughModel>();
    model->cloud = cloud_of(xyz, n);
    model->radius = static_cast<float>(frame_radius);
    model->neighbors = neighbors;
    model->frames = frames_of(model->cloud, model->cloud, normals_of(model->cloud, normals, neighbors), model->radius);
    return model.release();
} catch (...) {
    return nullptr;
}

void peers_pcl_hough_free(void* model) { delete static_cast<HoughModel*>(model); }

// As peers_pcl_gc. Frames are computed at the matched points of the scene only, on the whole of it.
int peers_pcl_hough(const void* handle, const float* scene_xyz, const float* scene_normals, int q,
                    const std::int32_t* corr, int m, double bin, double threshold, int refit, int capacity, double* out,
                    int* counts) try {
    const auto& model = *static_cast<const HoughModel*>(handle);
    const auto scene = cloud_of(scene_xyz, q);
    const auto normals = normals_of(scene, scene_normals, model.neighbors);
    Cloud::Ptr points(new Cloud);
    std::unordered_map<int, int> point_of;
    for (int i = 0; i < m; ++i)
        if (point_of.emplace(corr[2 * i + 1], static_cast<int>(points->size())).second)
            points->push_back((*scene)[corr[2 * i + 1]]);
    const auto frames = frames_of(points, scene, normals, model.radius);

    // A point with too few neighbours has no frame, and PCL would vote with NaN.
    pcl::CorrespondencesPtr pairs(new pcl::Correspondences);
    for (int i = 0; i < m; ++i) {
        const int j = point_of[corr[2 * i + 1]];
        if (std::isfinite((*model.frames)[corr[2 * i]].x_axis[0]) && std::isfinite((*frames)[j].x_axis[0]))
            pairs->emplace_back(corr[2 * i], j, 0.0F);
    }
    if (pairs->empty()) return 0;

    pcl::Hough3DGrouping<Point, Point> grouping;
    grouping.setHoughBinSize(bin);
    grouping.setHoughThreshold(threshold);
    grouping.setUseInterpolation(true);
    grouping.setUseDistanceWeight(false);
    grouping.setInputCloud(model.cloud);
    grouping.setInputRf(model.frames);
    grouping.setSceneCloud(points);
    grouping.setSceneRf(frames);
    grouping.setModelSceneCorrespondences(pairs);
    Poses poses;
    std::vector<pcl::Correspondences> groups;
    grouping.recognize(poses, groups);
    return write(poses, groups, *model.cloud, *points, refit, capacity, out, counts);
} catch (...) {
    return -1;
}

}  // extern "C"
