// JPEG by libjpeg or libjpeg-turbo.
#pragma once

#include <csetjmp>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <string>

// jpeglib.h needs stdio.h before it.
#include <jpeglib.h>

#include "vlagents_ray/types.hpp"

namespace vlagents_ray::detail {

struct JpegFailure {
  jpeg_error_mgr manager;  // first: libjpeg hands out its address
  std::jmp_buf back;
  char message[JMSG_LENGTH_MAX];

  static void jump(j_common_ptr codec) {
    auto* self = reinterpret_cast<JpegFailure*>(codec->err);
    codec->err->format_message(codec, self->message);
    std::longjmp(self->back, 1);
  }
};

/// Compress into memory that the caller frees, also after a failure. No object here has a destructor: longjmp runs none.
inline bool compress_jpeg(const Image& image, int quality, unsigned char** data, unsigned long* size, JpegFailure* failure) {
  jpeg_compress_struct codec;
  codec.err = jpeg_std_error(&failure->manager);
  failure->manager.error_exit = &JpegFailure::jump;
  jpeg_create_compress(&codec);
  if (setjmp(failure->back) != 0) {
    jpeg_destroy_compress(&codec);
    return false;
  }
  jpeg_mem_dest(&codec, data, size);
  codec.image_width = static_cast<JDIMENSION>(image.width);
  codec.image_height = static_cast<JDIMENSION>(image.height);
  codec.input_components = 3;
  codec.in_color_space = JCS_RGB;
  jpeg_set_defaults(&codec);
  jpeg_set_quality(&codec, quality, TRUE);
  codec.comp_info[0].h_samp_factor = codec.comp_info[0].v_samp_factor = 1;  // 4:4:4: colours at full resolution
  jpeg_start_compress(&codec, TRUE);
  while (codec.next_scanline < codec.image_height) {
    auto* row = const_cast<JSAMPROW>(image.data.data() + std::size_t{codec.next_scanline} * image.width * 3);
    jpeg_write_scanlines(&codec, &row, 1);
  }
  jpeg_finish_compress(&codec);
  jpeg_destroy_compress(&codec);
  return true;
}

/// The image as a JPEG file, with colours at full resolution.
inline Image encode_jpeg(const Image& image, int quality) {
  unsigned char* data = nullptr;
  unsigned long size = 0;
  JpegFailure failure{};
  const bool done = compress_jpeg(image, quality, &data, &size, &failure);
  Bytes file = done ? Bytes(data, data + size) : Bytes();
  std::free(data);
  if (!done) throw Error("invalid_input", std::string("JPEG: ") + failure.message);
  return Image::file(std::move(file));
}

}  // namespace vlagents_ray::detail
