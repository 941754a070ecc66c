// SPDX-FileCopyrightText: 2026 surfel_mapper contributors
// SPDX-License-Identifier: Apache-2.0
//
// Times pcl::VoxelGrid and pcl::ApproximateVoxelGrid on points that come on stdin, 12 bytes each:
//
//   pcl_voxel_grid POINTS SIZE_M REPEATS
//
// Prints two lines: how many points each leaves, and the processor times in milliseconds.

#include <pcl/filters/approximate_voxel_grid.h>
#include <pcl/filters/voxel_grid.h>
#include <pcl/point_types.h>

#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <vector>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;

template <typename Filter>
void time(const Cloud::ConstPtr& cloud, float size, int repeats) {
  std::vector<double> times;
  Cloud left;
  for (int repeat = 0; repeat < repeats; ++repeat) {
    const std::clock_t start = std::clock();
    Filter filter;
    filter.setInputCloud(cloud);
    filter.setLeafSize(size, size, size);
    filter.filter(left);
    times.push_back(1e3 * (std::clock() - start) / CLOCKS_PER_SEC);
  }
  std::printf("%zu", left.size());
  for (const double took : times) std::printf(" %.4f", took);
  std::printf("\n");
}

int main(int argc, char** argv) {
  if (argc != 4) return 2;
  const size_t number = std::strtoul(argv[1], nullptr, 10);
  Cloud::Ptr cloud(new Cloud);
  for (size_t i = 0; i < number; ++i) {
    float xyz[3];
    if (std::fread(xyz, sizeof xyz, 1, stdin) != 1) return 2;
    cloud->push_back(pcl::PointXYZ(xyz[0], xyz[1], xyz[2]));
  }
  const float size = std::strtof(argv[2], nullptr);
  const int repeats = std::atoi(argv[3]);
  time<pcl::VoxelGrid<pcl::PointXYZ>>(cloud, size, repeats);
  time<pcl::ApproximateVoxelGrid<pcl::PointXYZ>>(cloud, size, repeats);
}
