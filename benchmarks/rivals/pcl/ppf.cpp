// PPFRegistration (Drost et al. 2010); PCL's example ppf_object_recognition.
#include "rival.h"

#include <pcl/features/ppf.h>
#include <pcl/registration/ppf_registration.h>

#include <algorithm>
#include <random>

namespace {

constexpr float kAngleStep = 12.0f * static_cast<float>(M_PI) / 180.0f;
// The example's, in voxels: distance step 0.05 at a leaf of 0.02.
constexpr float kDistanceStep = 2.5f;
constexpr unsigned kReferenceRate = 2;  // the example: 10
// The example lumps poses within ten leaves; their mean is then too far from any for ICP.
constexpr float kPositionCluster = 3.0f, kRotationCluster = 30.0f * static_cast<float>(M_PI) / 180.0f;

// All pairs of a thousand points take its hash table more than three minutes; half as many, a second.
constexpr float kSpacing = 1.5f;

// Points of which none is within the spacing of another, in the order given.
Cloud::Ptr sparse(const Cloud& cloud, float spacing) {
  Cloud::Ptr kept(new Cloud);
  for (const auto& point : cloud) {
    const bool alone = std::none_of(kept->begin(), kept->end(), [&](const auto& other) {
      return (point.getVector3fMap() - other.getVector3fMap()).norm() < spacing;
    });
    if (alone) kept->push_back(point);
  }
  return kept;
}

class Ppf {
 public:
  Ppf(const Cloud::Ptr& model, float voxel, float)
      : model_(sparse(*model, kSpacing * voxel)), voxel_(voxel),
        search_(new pcl::PPFHashMapSearch(kAngleStep, kDistanceStep * voxel)) {
    pcl::PPFEstimation<pcl::PointNormal, pcl::PointNormal, pcl::PPFSignature> estimation;
    estimation.setInputCloud(model_);
    estimation.setInputNormals(model_);
    pcl::PointCloud<pcl::PPFSignature>::Ptr features(new pcl::PointCloud<pcl::PPFSignature>);
    estimation.compute(*features);
    search_->setInputFeatureCloud(features);
  }

  Poses match(const Cloud::Ptr& scene) const {
    // It gives one pose, always the same; in another order other points are references, and several tries differ.
    std::shuffle(scene->begin(), scene->end(), std::mt19937(std::rand()));
    pcl::PPFRegistration<pcl::PointNormal, pcl::PointNormal> align;
    align.setSceneReferencePointSamplingRate(kReferenceRate);
    align.setPositionClusteringThreshold(kPositionCluster * voxel_);
    align.setRotationClusteringThreshold(kRotationCluster);
    align.setSearchMethod(search_);
    align.setInputSource(model_);
    align.setInputTarget(sparse(*scene, kSpacing * voxel_));
    Cloud moved;
    align.align(moved);
    return {align.getFinalTransformation()};
  }

 private:
  Cloud::Ptr model_;
  float voxel_;
  pcl::PPFHashMapSearch::Ptr search_;
};

}  // namespace

int main(int argc, char** argv) { return converse<Ppf>(argc, argv); }
