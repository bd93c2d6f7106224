// What the three PCL rivals share: clouds from files, and the conversation with inside/pcl.py.
//
// RIVAL MODEL VOXEL DIAMETER
// trains on the model, says "trained", then for each line "SCENE SEED" on stdin answers with the number of poses and
// that many lines of twelve numbers: three rows of scene_from_model, metres.
#pragma once

#include <pcl/point_types.h>
#include <pcl/point_cloud.h>

#include <unistd.h>

#include <Eigen/Core>
#include <cstdio>
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
  // PCL prints what it does; only answers go to stdout.
  std::FILE* answers = fdopen(dup(STDOUT_FILENO), "w");
  dup2(STDERR_FILENO, STDOUT_FILENO);
  Rival rival(read_cloud(argv[1]), std::stof(argv[2]), std::stof(argv[3]));
  std::fprintf(answers, "trained\n");
  std::fflush(answers);
  std::string path;
  unsigned seed = 0;
  while (std::cin >> path >> seed) {
    std::srand(seed);  // all three draw with rand()
    const Poses poses = rival.match(read_cloud(path));
    std::fprintf(answers, "%zu\n", poses.size());
    for (const auto& pose : poses) {
      for (int i = 0; i < 12; ++i) std::fprintf(answers, "%.9g ", pose(i / 4, i % 4));
      std::fprintf(answers, "\n");
    }
    std::fflush(answers);
  }
  return 0;
} catch (const std::exception& error) {
  std::cerr << error.what() << '\n';
  return 1;
}
