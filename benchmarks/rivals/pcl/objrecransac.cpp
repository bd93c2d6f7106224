// ObjRecRANSAC (Papazov & Burschka 2010), looked at along six directions.
#include "rival.h"

#include <pcl/recognition/ransac_based/obj_rec_ransac.h>

#include <algorithm>
#include <list>

namespace {

constexpr float kPairWidth = 0.4f;  // of the diameter; its documentation: half of what is seen
constexpr float kLeaf = 1.5f;       // in voxels: at one, a scene thinned on another grid leaves holes in its octree
constexpr float kCoplanarityDegrees = 15.0f;
constexpr double kSuccess = 0.999;

// The defaults suit a table top: an object is a twentieth of the scene there, and hardly a point may stick out.
class Recogniser : public pcl::recognition::ObjRecRANSAC {
 public:
  Recogniser(float pair_width, float voxel) : ObjRecRANSAC(pair_width, voxel) {
    relative_obj_size_ = 0.01f;
    relative_num_of_illegal_pts_ = 0.2f;
    setMaxCoplanarityAngleDegrees(kCoplanarityDegrees);
  }
};

void split(const Cloud& cloud, const Eigen::Matrix3f& turn, pcl::PointCloud<pcl::PointXYZ>& points,
           pcl::PointCloud<pcl::Normal>& normals) {
  for (const auto& p : cloud) {
    const Eigen::Vector3f x = turn * p.getVector3fMap(), n = turn * p.getNormalVector3fMap();
    points.emplace_back(x.x(), x.y(), x.z());
    normals.emplace_back(n.x(), n.y(), n.z());
  }
}

// The class takes a scene for one range image seen along +z. A merged scan of several stations is none: seen along
// one axis its visibility test rejects right answers, seen along six one of them lets them pass.
std::vector<Eigen::Matrix3f> views() {
  std::vector<Eigen::Matrix3f> turns;
  for (int axis = 0; axis < 3; ++axis)
    for (float sign : {1.0f, -1.0f}) {
      const Eigen::Vector3f forward = sign * Eigen::Vector3f::Unit(axis);
      turns.push_back(Eigen::Quaternionf::FromTwoVectors(forward, Eigen::Vector3f::UnitZ()).toRotationMatrix());
    }
  return turns;
}

class ObjRecRansac {
 public:
  ObjRecRansac(const Cloud::Ptr& model, float voxel, float diameter) : recogniser_(kPairWidth * diameter, kLeaf * voxel) {
    pcl::PointCloud<pcl::PointXYZ> points;
    pcl::PointCloud<pcl::Normal> normals;
    split(*model, Eigen::Matrix3f::Identity(), points, normals);
    recogniser_.addModel(points, normals, "model");
  }

  Poses match(const Cloud::Ptr& scene) {
    std::vector<std::pair<float, Eigen::Matrix4f>> found;
    for (const auto& turn : views()) {
      pcl::PointCloud<pcl::PointXYZ> points;
      pcl::PointCloud<pcl::Normal> normals;
      split(*scene, turn, points, normals);
      std::list<pcl::recognition::ObjRecRANSAC::Output> outputs;
      recogniser_.recognize(points, normals, outputs, kSuccess);
      for (const auto& one : outputs) {
        Eigen::Matrix4f pose = Eigen::Matrix4f::Identity(), back = Eigen::Matrix4f::Identity();
        pose.topLeftCorner<3, 3>() = Eigen::Map<const Eigen::Matrix<float, 3, 3, Eigen::RowMajor>>(one.rigid_transform_);
        pose.topRightCorner<3, 1>() = Eigen::Map<const Eigen::Vector3f>(one.rigid_transform_ + 9);
        back.topLeftCorner<3, 3>() = turn.transpose();
        found.emplace_back(one.match_confidence_, back * pose);
      }
    }
    std::sort(found.begin(), found.end(), [](const auto& a, const auto& b) { return a.first > b.first; });
    Poses poses;
    for (const auto& one : found) poses.push_back(one.second);
    return poses;
  }

 private:
  Recogniser recogniser_;
};

}  // namespace

int main(int argc, char** argv) { return converse<ObjRecRansac>(argc, argv); }
