// SampleConsensusPrerejective (Buch et al. 2013) on FPFH; PCL's tutorial "Robust pose estimation of rigid objects".
#include "rival.h"

#include <pcl/features/fpfh_omp.h>
#include <pcl/registration/sample_consensus_prerejective.h>

namespace {

using Feature = pcl::FPFHSignature33;
using Features = pcl::PointCloud<Feature>;

// The tutorial's, in voxels: radius 25 mm and distance 12.5 mm at a leaf of 5 mm.
constexpr float kRadius = 5.0f, kDistance = 2.5f;
constexpr int kIterations = 500000, kSamples = 3, kRandomness = 5;
constexpr float kSimilarity = 0.9f;
// The tutorial's quarter is more than three stations see of a frame; the check afterwards judges.
constexpr float kInliers = 0.1f;

class Prerejective {
 public:
  Prerejective(Cloud::Ptr model, float voxel, float) : model_(std::move(model)), voxel_(voxel), features_(describe(model_)) {}

  Poses match(const Cloud::Ptr& scene) const {
    pcl::SampleConsensusPrerejective<pcl::PointNormal, pcl::PointNormal, Feature> align;
    align.setInputSource(model_);
    align.setSourceFeatures(features_);
    align.setInputTarget(scene);
    align.setTargetFeatures(describe(scene));
    align.setMaximumIterations(kIterations);
    align.setNumberOfSamples(kSamples);
    align.setCorrespondenceRandomness(kRandomness);
    align.setSimilarityThreshold(kSimilarity);
    align.setMaxCorrespondenceDistance(kDistance * voxel_);
    align.setInlierFraction(kInliers);
    Cloud moved;
    align.align(moved);
    if (!align.hasConverged()) return {};
    return {align.getFinalTransformation()};
  }

 private:
  Features::Ptr describe(const Cloud::Ptr& cloud) const {
    pcl::FPFHEstimationOMP<pcl::PointNormal, pcl::PointNormal, Feature> estimation;
    estimation.setRadiusSearch(kRadius * voxel_);
    estimation.setInputCloud(cloud);
    estimation.setInputNormals(cloud);
    Features::Ptr features(new Features);
    estimation.compute(*features);
    return features;
  }

  Cloud::Ptr model_;
  float voxel_;
  Features::Ptr features_;
};

}  // namespace

int main(int argc, char** argv) { return converse<Prerejective>(argc, argv); }
