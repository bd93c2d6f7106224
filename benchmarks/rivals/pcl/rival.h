// What the three PCL rivals share: clouds from files, and the conversation with inside/pcl.py.
//
// RIVAL MODEL VOXEL DIAMETER
// trains on the model, says "trained", then for each line "SCENE SEED" on stdin answers with the number of poses and
// that many lines of twelve numbers: three rows of scene_from_model, metres.
#pragma once

#include <pcl/point_types.h>
#include <pcl/point_cloud.h>

#include <Eigen/Core>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

using Cloud = pcl::PointCloud<pcl::PointNormal>;
using Poses = std::vector<Eigen::Matrix4f>;

// Rows of six float32: position, normal.
inline Cloud::Ptr read_cloud(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error("cannot read " + path);
  Cloud::Ptr cloud(new Cloud);
  float row[6];
  while (file.read(reinterpret_cast<char*>(row), sizeof row)) {
    pcl::PointNormal point;
    point.getVector3fMap() << row[0], row[1], row[2];
    point.getNormalVector3fMap() << row[3], row[4], row[5];
    cloud->push_back(point);
  }
  return cloud;
}

// Rival: a constructor from (model, voxel, diameter), which trains, and match(scene) → Poses, best first.
template <typename Rival>
int converse(int argc, char** argv) try {
  if (argc != 4) throw std::runtime_error("usage: RIVAL MODEL VOXEL DIAMETER");
  Rival rival(read_cloud(argv[1]), std::stof(argv[2]), std::stof(argv[3]));
  std::cout << "trained" << std::endl;
  std::string path;
  unsigned seed = 0;
  while (std::cin >> path >> seed) {
    std::srand(seed);  // all three draw with rand()
    const Poses poses = rival.match(read_cloud(path));
    std::cout << poses.size() << '\n';
    for (const auto& pose : poses) {
      for (int i = 0; i < 12; ++i) std::cout << pose(i / 4, i % 4) << ' ';
      std::cout << '\n';
    }
    std::cout << std::flush;
  }
  return 0;
} catch (const std::exception& error) {
  std::cerr << error.what() << '\n';
  return 1;
}
