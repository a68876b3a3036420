// An arm whose joints turn about z: placements are rotation (row by row) and translation of each joint in its parent, then
// the tip's.
#include <pinocchio/algorithm/frames.hpp>
#include <pinocchio/multibody.hpp>

using pinocchio::SE3;
using RowMatrix3 = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

static SE3 placement(const double *p) {
  return SE3(Eigen::Map<const RowMatrix3>(p), Eigen::Map<const Eigen::Vector3d>(p + 9));
}

// Fills the model; gives the tip's frame.
static pinocchio::FrameIndex build(pinocchio::Model &model, int joints, const double *placements) {
  pinocchio::JointIndex last = 0;
  for (int j = 0; j < joints; ++j)
    last = model.addJoint(last, pinocchio::JointModelRZ(), placement(placements + 12 * j), "q" + std::to_string(j));
  return model.addFrame(
      pinocchio::Frame("tip", last, 0, placement(placements + 12 * joints), pinocchio::OP_FRAME));
}
